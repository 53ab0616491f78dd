"""Judge the impulses of MJX in many worlds of a model with pyramidal cones: python examples/judge_mjx.py MODEL.xml.

With elliptic cones pass `contacts=` too: (world, efc_address, dim, friction) with an entry for each contact.
In MJX all worlds have the same contacts.
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def judge(model, datas):
    """Return the residuals of MJX's impulses in the worlds of `datas`, a list of `MjData`."""
    import jax
    import mujoco
    from mujoco import mjx

    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    m = mjx.put_model(model)
    names = ("qpos", "qvel", "ctrl", "qacc_warmstart")
    fields = {name: np.array([getattr(d, name) for d in datas]) for name in names}
    d = jax.vmap(lambda own: mjx.make_data(m).replace(**own))(fields)
    d = jax.jit(jax.vmap(lambda d: mjx.forward(m, d)))(d)
    e = d._impl
    batch, impulse = lv.io.from_efc(
        efc_J=e.efc_J,
        efc_D=e.efc_D,
        efc_aref=e.efc_aref,
        efc_type=e.efc_type,
        efc_frictionloss=e.efc_frictionloss,
        efc_force=e.efc_force,
        M=e.M,
        qvel=d.qvel,
        qacc_smooth=d.qacc_smooth,
        qfrc_smooth=d.qfrc_smooth,
        timestep=m.opt.timestep,
    )
    return lv.residual_many(batch, impulse)


def main():
    """Judge 64 worlds of a model with random velocities."""
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/judge_mjx.py MODEL.xml")
    for name, package in (
        ("mujoco", "mujoco"),
        ("jax", "mujoco-mjx"),
        ("mujoco.mjx", "mujoco-mjx"),
    ):
        if importlib.util.find_spec(name) is None:
            sys.exit(f"{name} is not installed: pip install {package}")
    import mujoco

    model = mujoco.MjModel.from_xml_path(sys.argv[1])
    datas = [mujoco.MjData(model) for _ in range(64)]
    for i, data in enumerate(datas):
        data.qvel[:] = 0.1 * np.random.default_rng(i).standard_normal(model.nv)
    found = judge(model, datas)
    print(
        f"largest velocity error {found.velocity_error.max():.2g} m/s, {sorted(set(found.verdict))}"
    )


if __name__ == "__main__":
    main()
