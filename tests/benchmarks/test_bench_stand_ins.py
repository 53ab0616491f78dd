"""Each engine and solver of the comparisons runs once: packages that are not installed have stand-ins here.

A stand-in has the names and arguments that the adapter uses, so that a name that is renamed on either side of an
adapter fails here and not in the next comparison.
"""

import importlib.util
import pkgutil
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import scipy.sparse as sp

import benchmarks
import lavender as lv
from benchmarks import engines as engine_modules
from benchmarks.peers import adapters, engines
from lavender import registry, suite
from lavender.external.backend import Backend
from lavender.external.backends import BACKENDS

CASES = ("two_particles", "box_stack(n=2)", "chain(n=4)", "box_stack(n=2, friction=cone)", "box_stackF(n=2)")
# The loosest third of the settings reach this residual on problems of a few rows.
CLOSE = 1e-2


@pytest.fixture(scope="module")
def problems():
    return [suite.case(name).problem for name in CASES]


def run_once(contestant, problems):
    """Return the residual of one run on the first problem that the contestant accepts."""
    for problem in problems:
        if contestant.refuses(problem) is not None:
            continue
        calls = list(contestant.runs(problem, 5.0))
        if calls:
            seconds, impulse = calls[min(6, len(calls) - 1)]()
            assert seconds >= 0.0
            return lv.residual(problem, impulse).relative
    raise AssertionError(f"{contestant.name} accepts none of {CASES}")


@pytest.mark.parametrize("name", [m.name for m in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")])
def test_every_module_of_the_benchmarks_can_be_imported(name, monkeypatch):
    for package in ("pybullet", "lavendersim", "mujoco"):
        if importlib.util.find_spec(package) is None:
            monkeypatch.setitem(sys.modules, package, MagicMock())
    monkeypatch.delitem(sys.modules, name, raising=False)
    if name.endswith(("__main__", "siconos_server", "kernels.microbenchmarks")):
        pytest.skip("it is a program, or compiled when it is run")
    known = sys.modules.copy()
    parent = importlib.import_module(name.rpartition(".")[0])
    names = dict(vars(parent))
    try:
        assert importlib.import_module(name).__doc__
    finally:  # Modules that hold a stand-in, or classes of a second import, must not stay.
        for other in set(sys.modules) - set(known):
            if other.startswith("benchmarks."):
                del sys.modules[other]
        sys.modules.update(known)
        vars(parent).update(names)  # A second import binds the module to its name in the package.


def test_each_solver_of_lavender_runs(problems):
    for contestant in adapters.ours():
        assert run_once(contestant, problems) < CLOSE, contestant.name


def test_each_qp_backend_runs_or_its_stand_in(problems, monkeypatch):
    """A backend that is not installed gets the answer of Clarabel to the program that the adapter made for it."""
    pytest.importorskip("clarabel", reason="the stand-in of other backends (extra: qp)")
    is_absent = {b.name: registry.specs()[b.name].missing() is not None for b in BACKENDS}
    assert not is_absent["clarabel"]
    for backend in BACKENDS:
        for module in backend.modules if is_absent[backend.name] else ():
            # Two backends share a module, which the first has replaced already.
            if module not in sys.modules and importlib.util.find_spec(module) is None:
                monkeypatch.setitem(sys.modules, module, MagicMock())  # Its calls are timed.
    clarabel, own = next(b for b in BACKENDS if b.name == "clarabel"), Backend.run

    def run(self, qp, impulse, limit, settings):
        assert not settings
        return own(clarabel if is_absent[self.name] else self, qp, impulse, limit, settings)

    monkeypatch.setattr(Backend, "run", run)
    monkeypatch.setattr(type(registry.get("clarabel")), "missing", lambda _: None)
    monkeypatch.setattr(adapters, "is_installed", lambda name: False)
    contestants = adapters.contestants()
    assert len(contestants) >= 2 * len(BACKENDS)
    for contestant in contestants:
        assert run_once(contestant, problems) < CLOSE, contestant.name


def make_qoco():
    """Return a module `qoco` that solves by Clarabel."""
    import clarabel

    class QOCO:
        def setup(self, n, m, p, P, c, A, b, G, h, n_nonneg, n_soc, q, *, abstol, reltol, verbose, max_iters):
            assert (G.shape, len(h), n_soc, n_nonneg + sum(q)) == ((m, n), m, len(q), m)
            rows, rhs = (G, h) if A is None else (sp.vstack([A, G]), np.concatenate([b, h]))
            assert p == (0 if A is None else len(b)) and abstol > 0.0 and max_iters > 0 and not verbose
            cones = [clarabel.ZeroConeT(p)] * (p > 0) + [clarabel.NonnegativeConeT(n_nonneg)] * (n_nonneg > 0)
            cones += [clarabel.SecondOrderConeT(int(size)) for size in q]
            settings, self.p = clarabel.DefaultSettings(), p
            settings.verbose = False
            self.solver = clarabel.DefaultSolver(P, c, sp.csc_matrix(rows), rhs, cones, settings)

        def solve(self):
            found = self.solver.solve()
            return SimpleNamespace(x=found.x, y=found.z[: self.p], z=found.z[self.p :])

    return SimpleNamespace(QOCO=QOCO)


def make_pinocchio():
    """Return a module `pinocchio` whose ADMM is lavender's Newton method, in its order: tangents before the normal."""

    class Solver:
        def __init__(self, m):
            self.m = m

        def solve(self, operator, g, models, datas, settings, result):
            order = np.arange(self.m).reshape(-1, 3)[:, [2, 0, 1]].ravel()
            mu = [model.mu for model in models]
            assert len(datas) == len(mu) and settings.max_iterations > 0
            law = "coulomb" if settings.solve_ncp else "cone"
            problem = lv.Problem.contact(operator[order][:, order], -g[order], mu=mu, friction=law)
            x = np.empty(self.m)
            x[order] = lv.solve(problem, tol=settings.absolute_feasibility_tol).impulse
            result.impulses = x

    class Result:
        def retrieveConstraintImpulses(self):
            return self.impulses

    class Contact:
        def __init__(self, model, joint):
            assert joint == 1

        def setFriction(self, mu):
            self.mu = mu

        def createData(self):
            return object()

    return SimpleNamespace(
        Model=lambda: SimpleNamespace(addJoint=lambda parent, joint, place, name: parent + 1),
        JointModelFreeFlyer=object, SE3=SimpleNamespace(Identity=object), PointContactConstraintModel=Contact,
        ConstraintModel=lambda model: model, StdVec_ConstraintModel=list, StdVec_ConstraintData=list,
        DelassusOperatorSparse=lambda a: a, ADMMSolverSettings=SimpleNamespace, ADMMSolverResult=Result,
        ADMMConstraintSolver=Solver,
    )  # fmt: skip


@pytest.mark.parametrize(("package", "make"), [("qoco", make_qoco), ("pinocchio", make_pinocchio)])
def test_each_solver_with_an_adapter_of_its_own_runs_on_a_stand_in(package, make, problems, monkeypatch):
    pytest.importorskip("clarabel", reason="the stand-in of qoco (extra: qp)")
    monkeypatch.setitem(sys.modules, package, make())
    monkeypatch.setattr(adapters, "is_installed", lambda name: name == package)
    chosen = [c for c in adapters.contestants() if c.name.startswith(package)]
    assert len(chosen) == 2
    for contestant in chosen:
        assert run_once(contestant, problems) < CLOSE, contestant.name


SICONOS = """#!{python}
import runpy, sys
from collections import defaultdict
from types import ModuleType, SimpleNamespace
import numpy as np
import lavender as lv

def solve(problem, x, y, options):
    x[:] = lv.solve(problem, tol=options.dparam["SICONOS_DPARAM_TOL"]).impulse
    options.iparam["SICONOS_IPARAM_ITER_DONE"] = 1
    return 0

class Numerics(ModuleType):
    def __getattr__(self, name):
        if name.startswith("SICONOS_"):
            return name
        raise AttributeError(name)

numerics = Numerics("siconos.numerics")
numerics.SolverOptions = lambda solver: SimpleNamespace(dparam={{}}, iparam={{}})
numerics.solver_options_update_internal = lambda options, i, solver: None
numerics.FrictionContactProblem = lambda d, n, w, q, mu: lv.Problem.contact(w, -q, mu=mu)
numerics.LCP = lambda w, q: lv.Problem.lcp(w, -q)
numerics.fc3d_driver = numerics.linearComplementarity_driver = solve
package = ModuleType("siconos")
package.numerics = numerics
sys.modules.update({{"siconos": package, "siconos.numerics": numerics}})
assert sys.argv[1] == "-I"
if sys.argv[2] == "-c":
    exec(sys.argv[3])
else:
    sys.argv = sys.argv[2:]
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a script is no program on Windows")
def test_each_solver_of_siconos_runs_on_a_stand_in(problems, tmp_path, monkeypatch):
    monkeypatch.setattr(adapters, "LADDER", (1e-4, 1e-8))
    python = tmp_path / "python"
    python.write_text(SICONOS.format(python=sys.executable))
    python.chmod(0o755)
    chosen = [c for c in adapters.contestants(str(python)) if c.name.startswith("siconos")]
    assert len(chosen) == len(adapters.SICONOS_FRICTION) + len(adapters.SICONOS_LCP)
    for contestant in chosen[:2] + chosen[-2:]:  # The others differ by the name that they give to Siconos.
        assert run_once(contestant, problems) < CLOSE, contestant.name


def make_pybullet():
    """Return a module `pybullet` in which nothing moves and one point is in contact."""
    module = MagicMock(spec_set=(
        "connect", "disconnect", "DIRECT", "setGravity", "setPhysicsEngineParameter", "createCollisionShape",
        "GEOM_PLANE", "GEOM_SPHERE", "GEOM_BOX", "createMultiBody", "resetBaseVelocity", "createConstraint",
        "JOINT_POINT2POINT", "setCollisionFilterGroupMask", "changeDynamics", "ACTIVATION_STATE_DISABLE_SLEEPING",
        "stepSimulation", "getBasePositionAndOrientation", "getBaseVelocity", "getContactPoints",
    ))  # fmt: skip
    module.createMultiBody.side_effect = range(1000)
    module.createCollisionShape.return_value = 0
    module.getBasePositionAndOrientation.return_value = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0)
    module.getBaseVelocity.return_value = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    module.getContactPoints.return_value = [(0,) * 8 + (-1e-3,)]
    return module


@pytest.fixture
def pybullet(monkeypatch):
    module = make_pybullet()
    monkeypatch.setitem(sys.modules, "pybullet", module)
    monkeypatch.delitem(sys.modules, "benchmarks.engines.bullet", raising=False)
    yield module
    sys.modules.pop("benchmarks.engines.bullet", None)


def test_the_engine_of_bullet_runs_on_a_stand_in(pybullet, monkeypatch):
    monkeypatch.setattr(engines, "get_missing_installation_command", lambda needs: None)
    (step,) = engines.measure_scene("box", 4, engines=("pybullet",), settle=3, rounds=2)
    assert step.note == "" and step.time > 0.0
    assert (step.contacts, step.depth, step.speed) == (1, 1e-3, 0.0)
    engine = engine_modules.create_engine("bullet", lv.Scene("chain", n=2), sweeps=4)
    engine.step()
    assert (
        engine.measure_last_step()[1] > 0.0
    )  # All bodies of the stand-in are in one place: the joints are open.
    assert pybullet.createConstraint.called
    engine.close()


def test_engines_of_node_run_on_a_stand_in(tmp_path, monkeypatch):
    node = importlib.import_module("benchmarks.engines.node")

    class Program:
        def __init__(self, command):
            assert command[:2] == ["node", str(node.SCRIPT)] and node.SCRIPT.is_file()

        def request_answer(self, message):
            if "scene" in message:
                self.bodies = message["scene"]["bodies"]
            return {"cpu": 0.25, "state": [x for body in self.bodies for x in body["still"]]}

        def close(self):
            pass

    monkeypatch.setattr(node, "JsonLines", Program)
    monkeypatch.setattr(node, "find_node_folder", lambda package: tmp_path)
    scene = lv.Scene("stack", n=2)
    for name in engine_modules.PACKAGES_OF_NODE:
        engine = engine_modules.create_engine("node", scene, engine=name)
        engine.advance(2)
        assert engine.get_cpu_time() == 0.25
        position, quaternion, velocity = engine.get_state()
        np.testing.assert_array_equal(position, [body.position for body in scene.bodies])
        np.testing.assert_array_equal(quaternion, [body.quaternion for body in scene.bodies])
        assert not velocity.any()
        engine.close()


def test_the_engine_of_lavendersim_runs_on_a_stand_in(monkeypatch):
    class Scene:
        def __init__(self, name, *, gravity, solver_iterations, ground):
            assert gravity < 0.0 and solver_iterations == 4 and not ground
            self.states = []

        def box(self, name, *, position, rotation, **options):
            velocity, spin = (options.get(f"{word}_velocity", np.zeros(3)) for word in ("linear", "angular"))
            self.states.append(np.concatenate([position, rotation, velocity, spin]))

        sphere = box

    class Env:
        def __init__(self, scene, *, control_dt, horizon):
            assert control_dt == 1.0 / 60.0 and horizon is None
            self.body_state = lambda: [
                np.zeros(13),
                *scene.states,
            ]  # The engine has a body of its own before them.

        def reset(self):
            pass

        step = close = reset

    monkeypatch.setitem(sys.modules, "lavendersim", SimpleNamespace(Scene=Scene, CodeSceneEnv=Env))
    monkeypatch.delitem(sys.modules, "benchmarks.engines.lavender_sim", raising=False)
    scene = lv.Scene("stack", n=2)
    engine = engine_modules.create_engine("lavender_sim", scene, sweeps=4)
    try:
        engine.step()
        position, quaternion, velocity = engine.get_state()
        for i, body in enumerate(scene.bodies):
            if body.mass:
                np.testing.assert_allclose(position[i], body.position, atol=1e-12)
                assert abs(quaternion[i] @ body.quaternion) == pytest.approx(1.0)
        assert not velocity.any()
        engine.close()
    finally:
        sys.modules.pop("benchmarks.engines.lavender_sim", None)
