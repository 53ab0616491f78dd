"""Compare the joints of a converted MuJoCo model with those of its source, both read by MuJoCo.

Converters of URDF files lose values without a message. `lavender audit` judges the steps of the model that it gets, so
compare first. The two arguments are any files that MuJoCo reads, for example a URDF and the MJCF file made from it;
without arguments, a pendulum is compared with the same pendulum without its friction loss, its limit of effort and the
gear of its motor.

    python examples/compare_models.py robot.urdf converted.xml
"""

import sys

import numpy as np

PENDULUM = """<mujoco><worldbody><body name="arm"><joint name="hinge" damping="0.5" {}/>
<geom type="sphere" size="0.1" pos="0 0 -1"/></body></worldbody>
<actuator><motor joint="hinge" gear="{}"/></actuator></mujoco>"""


def read_joints(model):
    """Return the values of each slide (type 2) and hinge (type 3) joint, by its name."""
    joints = {}
    for i in np.flatnonzero(model.jnt_type >= 2):
        dof = model.jnt_dofadr[i]
        effort = model.jnt_actfrcrange[i, 1] if model.jnt_actfrclimited[i] else np.inf
        own = (model.actuator_trntype == 0) & (model.actuator_trnid[:, 0] == i)
        limited = own & (model.actuator_forcelimited > 0)
        limits = model.actuator_forcerange[:, 1] * model.actuator_gear[:, 0]
        # The force on the joint per unit of control, of each actuator.
        gains = model.actuator_gainprm[own, 0] * model.actuator_gear[own, 0]
        joints[model.joint(i).name] = {
            "damping": model.dof_damping[dof],
            "friction": model.dof_frictionloss[dof],
            "stiffness": float(np.ravel(model.jnt_stiffness[i])[0]),
            "armature": model.dof_armature[dof],
            "force per control": tuple(map(float, gains)),
            "effort": min([effort, *limits[limited]]),
            "limits": tuple(map(float, model.jnt_range[i])) if model.jnt_limited[i] else "none",
        }
    return joints


def compare(source, other):
    """Print the values of joints that differ, and the counts and masses of both models."""
    before, after = read_joints(source), read_joints(other)
    for name in before:
        for key, value in before[name].items():
            if name not in after or not np.array_equal(value, after[name][key]):
                print(
                    f"{name}: {key} {value}, converted {after[name][key] if name in after else 'no such joint'}"
                )
    for key, count in {"equalities (mimic)": "neq", "joints": "njnt"}.items():
        print(f"{key}: {getattr(source, count)}, converted {getattr(other, count)}")
    masses = [model.body_mass.sum() for model in (source, other)]
    print(
        f"mass without bodies fixed to the world: {masses[0]:.3f} kg, converted {masses[1]:.3f} kg"
    )


def main():
    """Compare the models in two files, or two pendulums."""
    import mujoco

    paths = sys.argv[1:]
    if len(paths) == 2:
        compare(*(mujoco.MjModel.from_xml_path(path) for path in paths))
    else:
        lost = 'frictionloss="0.2" actuatorfrcrange="-30 30"'
        texts = PENDULUM.format(lost, 50), PENDULUM.format("", 1)
        compare(*(mujoco.MjModel.from_xml_string(text) for text in texts))


if __name__ == "__main__":
    main()
