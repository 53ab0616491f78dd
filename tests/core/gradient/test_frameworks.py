"""`lavender.torch` and `lavender.jax`: gradients by the frameworks' own checks, batches, and what they refuse."""

import numpy as np
import pytest

import lavender as lv
from lavender.gradient.layer import make_step


def arrays(seed, contacts=2, tangents=2, nv=5):
    """J, M, v*, mu, target and compliance of a step in which some contact slides and some sticks."""
    rng = np.random.default_rng(seed)
    m = contacts * (1 + tangents)
    jac = rng.standard_normal((m, nv))
    root = 0.3 * rng.standard_normal((nv, nv))
    target = 0.3 * rng.standard_normal(m)
    free = np.linalg.lstsq(jac[:: 1 + tangents], np.full(contacts, -2.0), rcond=None)[0]
    mu, soft = rng.uniform(0.2, 1.0, contacts), rng.uniform(0.05, 0.1, m)
    return jac, np.eye(nv) + root @ root.T, free + 0.2 * rng.standard_normal(nv), mu, target, soft


def is_smooth(given):
    made = make_step(given, None, "coulomb", "auto", 1e-12)
    _, impulse = made.forward(*given)
    problem = made.make_batch([x[None] for x in given])[0]
    return float(lv.derivative(problem, impulse).distance.min()) > 1e-2


GIVEN = [given for given in map(arrays, range(12)) if is_smooth(given)][:3]
assert len(GIVEN) == 3
EVERY = (True,) * 6


def test_gradient_of_broadcast_arguments_is_summed():
    jac, mass, free, mu, target, soft = GIVEN[0]
    made = make_step((jac, mass, free, mu, target, soft), None, "coulomb", "auto", 1e-12)
    frees = np.stack([free, free + 1e-3])
    velocity, impulse = made.forward(jac, mass, frees, mu, target, soft)
    assert velocity.shape == (2, 5) and impulse.shape == (2, 6)
    both = made.backward(
        EVERY, jac, mass, frees, mu, target, soft, impulse, np.ones((2, 5)), np.ones((2, 6))
    )
    alone = [
        made.backward(
            EVERY, jac, mass, frees[i], mu, target, soft, impulse[i], np.ones(5), np.ones(6)
        )
        for i in (0, 1)
    ]
    for i, (x, y, z) in enumerate(zip(both, *alone, strict=True)):
        assert x == pytest.approx(np.stack([y, z]) if i == 2 else y + z, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("lead", [(), (2,), (0,), (2, 3)])
def test_layer_without_contacts_returns_the_free_velocity_and_its_gradient(lead):
    """And so of batches, of none too."""
    shapes = (0, 3), (3, 3), (3,), (0,), (0,), (0,)
    given = [np.zeros((*lead, *shape)) for shape in shapes]
    given[1], given[2] = given[1] + np.eye(3), given[2] + [1.0, 2.0, 3.0]
    made = make_step(given, None, "coulomb", "auto", 1e-12)
    velocity, impulse = made.forward(*given)
    assert np.array_equal(velocity, given[2]) and impulse.shape == (*lead, 0)
    found = made.backward(EVERY, *given, impulse, 7.0 * np.ones_like(velocity), impulse)
    assert [x.shape for x in found] == [x.shape for x in given]
    assert (found[2] == 7.0).all() and not found[1].any()


def twice(by_mu):
    """A contact given twice: there is a gradient by the friction that both have, none by their J."""
    jac = np.concatenate([np.eye(3)[[2, 0, 1]]] * 2)
    assert by_mu(
        jac, 2.0 * np.eye(3), np.array([2.0, 0.0, -1.0]), np.array([0.4, 0.4])
    ) == pytest.approx(-1.0)


def torch_and_solve():
    torch = pytest.importorskip("torch")
    from lavender.torch import solve

    return torch, solve


@pytest.mark.parametrize("given", GIVEN)
def test_gradcheck_of_torch(given):
    torch, solve = torch_and_solve()
    tensors = [torch.tensor(x, requires_grad=True) for x in given]

    def function(J, M, v_free, mu, target, compliance):
        return solve(J, M, v_free, mu, target=target, compliance=compliance, tol=1e-14)

    assert torch.autograd.gradcheck(function, tensors, eps=1e-6, atol=1e-6)


def test_batches_of_torch():
    torch, solve = torch_and_solve()
    stacked = [torch.tensor(np.stack(x)) for x in zip(*GIVEN, strict=True)]
    velocity, impulse = solve(*stacked[:4], target=stacked[4], compliance=stacked[5])

    def each(*x):
        return solve(*x[:4], target=x[4], compliance=x[5])

    mapped = torch.vmap(each)(*stacked)
    assert torch.equal(mapped[0], velocity) and torch.equal(mapped[1], impulse)
    alone = each(*(x[1] for x in stacked))
    assert torch.allclose(alone[0], velocity[1], rtol=1e-9)
    # of a gradient, and of one argument alone
    of = torch.func.vmap(torch.func.grad(lambda mu, *x: each(*x[:3], mu, *x[3:])[0].sum()))
    by_mu = of(stacked[3], *stacked[:3], *stacked[4:])
    stacked[3].requires_grad_()
    solve(*stacked[:4], target=stacked[4], compliance=stacked[5])[0].sum().backward()
    assert torch.allclose(by_mu, stacked[3].grad, rtol=1e-9)
    frees = stacked[2][0] + 1e-3 * torch.arange(4, dtype=torch.float64)[:, None]
    one = torch.func.vmap(
        lambda v: each(*(x[0] for x in stacked[:2]), v, *(x[0].detach() for x in stacked[3:]))[0]
    )
    assert one(frees).shape == (4, 5)


def jax_and_solve():
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    from lavender.jax import solve

    return jax, solve


@pytest.mark.parametrize("given", GIVEN)
def test_check_grads_of_jax(given):
    jax, solve = jax_and_solve()
    from jax.test_util import check_grads

    def function(J, M, v_free, mu, target, compliance):
        return solve(J, M, v_free, mu, target=target, compliance=compliance, tol=1e-14)

    check_grads(
        function,
        tuple(map(jax.numpy.asarray, given)),
        order=1,
        modes=["rev"],
        eps=1e-6,
        atol=1e-5,
        rtol=1e-5,
    )


def test_batches_and_jit_of_jax():
    jax, solve = jax_and_solve()
    stacked = [jax.numpy.asarray(np.stack(x)) for x in zip(*GIVEN, strict=True)]

    def each(J, M, v_free, mu, target, compliance):
        return solve(J, M, v_free, mu, target=target, compliance=compliance)

    velocity, _ = each(*stacked)
    assert np.array_equal(jax.vmap(each)(*stacked)[0], velocity)
    assert np.array_equal(jax.jit(each)(*stacked)[0], velocity)
    by_mu = jax.grad(lambda mu, x: each(*x[:3], mu, *x[3:])[0].sum())
    whole = by_mu(stacked[3], (*stacked[:3], *stacked[4:]))
    mapped = jax.vmap(by_mu)(stacked[3], (*stacked[:3], *stacked[4:]))
    assert np.allclose(whole, mapped, rtol=1e-12)
    # one argument mapped, the others shared
    first = [x[0] for x in stacked]
    frees = first[2] + 1e-3 * np.arange(4.0)[:, None]
    one = jax.vmap(lambda v: each(*first[:2], v, *first[3:])[0])(frees)
    assert np.allclose(one[0], velocity[0], rtol=1e-9)


def test_vmap_of_jax_is_before_a_batch_inside():
    jax, solve = jax_and_solve()
    jac, mass, free, mu, target, soft = map(jax.numpy.asarray, GIVEN[0])
    many, frees = (x + 0.01 * jax.numpy.arange(3.0).reshape(3, *[1] * x.ndim) for x in (jac, free))

    def push(J):  # as many worlds inside as vmap adds outside
        return solve(J, mass, frees, mu, target=target, compliance=soft)[0]

    for function in (push, jax.grad(lambda J: push(J).sum())):
        assert np.allclose(
            jax.vmap(function)(many), np.stack([function(J) for J in many]), rtol=1e-9
        )


def test_torch_layer_computes_only_required_gradients():
    torch, solve = torch_and_solve()

    def by_mu(*given):
        *fixed, mu = map(torch.tensor, given)
        mu.requires_grad_()
        solve(*fixed, mu)[0][0].backward()
        return float(mu.grad.sum())

    twice(by_mu)
