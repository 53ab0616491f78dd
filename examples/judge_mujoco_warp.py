"""Judge the impulses of MuJoCo Warp in many worlds, on a GPU or the processor.

python examples/judge_mujoco_warp.py MODEL.xml
"""

import importlib.util
import sys

import numpy as np

import lavender as lv


def judge(model, datas):
    """Return the residuals of MuJoCo Warp's impulses in the worlds of `datas`, a list of `MjData`."""
    import mujoco
    import mujoco_warp as mjw

    m = mjw.put_model(model)
    d = mjw.put_data(model, mujoco.MjData(model), nworld=len(datas), njmax=256)
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
        getattr(d, name).assign(np.array([getattr(own, name) for own in datas], np.float32))
    mjw.forward(m, d)
    e, c = d.efc, d.contact
    batch, impulse = lv.io.from_efc(
        efc_J=e.J.numpy()[:, :, : model.nv],  # its columns are padded
        efc_D=e.D.numpy(),
        efc_aref=e.aref.numpy(),
        efc_type=e.type.numpy(),
        efc_frictionloss=e.frictionloss.numpy(),
        efc_force=e.force.numpy(),
        nefc=d.nefc.numpy(),
        M=(d.M.numpy(), model.M_colind, np.append(model.M_rowadr, len(model.M_colind))),
        qvel=d.qvel.numpy(),
        qacc_smooth=d.qacc_smooth.numpy(),
        qfrc_smooth=d.qfrc_smooth.numpy(),
        timestep=model.opt.timestep,
        contacts=(
            c.worldid.numpy(),
            c.efc_address.numpy()[:, 0],
            c.dim.numpy(),
            c.friction.numpy(),
        ),
    )
    return lv.residual_many(batch, impulse)


def main():
    """Judge 64 worlds of a model with random velocities."""
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/judge_mujoco_warp.py MODEL.xml")
    for name, package in (("mujoco", "mujoco"), ("mujoco_warp", "mujoco-warp")):
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
