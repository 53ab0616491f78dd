"""Stand-ins of solvers of engines that are not installed: recorded arrays, or those of MuJoCo, under their names."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
from mujoco_scene import mj, scene

FOLDER = Path(__file__).parent / "io"
MAX_ROWS = 64  # allotted by the stand-in of newton's SolverMuJoCo


class Recorded:
    """An array on a device, with the methods by which readers copy it."""

    def __init__(self, array):
        self.array = np.asarray(array)
        self.shape = self.array.shape

    def __getitem__(self, index):
        return Recorded(self.array[index])

    def __len__(self):
        return len(self.array)

    def cpu(self):
        return self

    def numpy(self):
        return self.array


class Node:
    """An object whose attributes are set from dotted paths; it can be weakly referenced."""


def load(file, model, changes):
    """Return an object with the arrays that a model has in a file, some of them changed."""
    root = Node()
    with np.load(FOLDER / file) as stored:
        for key in stored.files:
            if key.startswith(f"{model}/"):
                *path, last = key.split("/")[1].split(".")
                at = root
                for name in path:
                    if not hasattr(at, name):
                        setattr(at, name, Node())
                    at = getattr(at, name)
                array = changes.get(last, lambda x: x)(stored[key].copy())
                value = array.item() if array.ndim == 0 else Recorded(array)
                setattr(at, last, list(array) if last == "label" else value)
    return root


def make_kamino(model, **changes):
    """Return a SolverKamino: "mixed" worlds and "stacks" by PADMM, or by "dvi"; `record_kamino.py` recorded them."""
    solver = load("kamino_1.8.0.npz", model, changes)
    engine = solver._solver_kamino
    is_dvi = model == "dvi"
    engine._config = SimpleNamespace(
        dynamics_solver="dvi" if is_dvi else "padmm", sparse_jacobian=is_dvi, sparse_dynamics=False
    )
    engine.problem_fd.data.compliance = None
    return solver


class LegacyCoupler:
    """The default coupler of a scene of Genesis."""


def make_genesis(model, **changes):
    """Return a built scene of three environments: "arm", "convex" or "pyramids"; `record_genesis.py` recorded them."""
    made = load("genesis_1.4.5.npz", model, changes)
    made.is_built = True
    made.sim.coupler = LegacyCoupler()
    solver = made.sim.rigid_solver
    solver._options = SimpleNamespace(noslip_iterations=0)
    solver.rigid_config.enable_mujoco_compatibility = False
    # The default integrator, whose matrix has the damping, uses the solver's acceleration.
    solver.dyn_state.dofs.acc = solver.constraint_solver.constraint_state.qacc
    return made


def replace_genesis(monkeypatch):
    """Replace the engine's function that copies arrays to the host."""
    misc = ModuleType("genesis.utils.misc")
    misc.qd_to_torch = lambda value, copy=None: value
    for name in ("genesis", "genesis.utils"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "genesis.utils.misc", misc)


def make_newton_mujoco(cone="elliptic", n=3, **changes):
    """Return a SolverMuJoCo of newton with the arrays of n states of MuJoCo, padded, in float32."""
    model = mj.MjModel.from_xml_string(scene(cone=cone))
    rng = np.random.default_rng(0)
    worlds = []
    efc = {name: [] for name in ("J", "D", "aref", "type", "frictionloss", "force")}
    contact = {name: [] for name in ("worldid", "efc_address", "dim", "friction")}
    rest = {name: [] for name in ("qacc_smooth", "qfrc_smooth", "qacc", "M", "qvel")}
    for i in range(n):
        data = mj.MjData(model)
        data.qvel[:] = 0.3 * rng.standard_normal(model.nv)
        for _ in range(5 * i + 1):
            mj.mj_step(model, data)
        mj.mj_forward(model, data)
        worlds.append(data.nefc)
        for name, values in efc.items():
            x = data.efc_J.reshape(data.nefc, -1) if name == "J" else getattr(data, f"efc_{name}")
            padded = np.full((MAX_ROWS, *x.shape[1:]), 6, x.dtype)  # what an earlier step left
            padded[: data.nefc] = x
            values.append(padded)
        for name, values in contact.items():
            x = np.full(data.ncon, i) if name == "worldid" else getattr(data.contact, name)
            values.append(np.repeat(x[:, None], 4, axis=1) if name == "efc_address" else x)
        for name, values in rest.items():
            values.append(np.array(getattr(data, name)))
    kinds = dict.fromkeys(("type", "worldid", "efc_address", "dim"), np.int32)
    arrays = {k: Recorded(np.array(v).astype(kinds.get(k, np.float32))) for k, v in efc.items()}
    contacts = {
        k: Recorded(np.concatenate(v).astype(kinds.get(k, np.float32))) for k, v in contact.items()
    }
    others = {k: np.array(v, np.float32) for k, v in rest.items()}
    others = {k: Recorded(changes.get(k, lambda x: x)(x)) for k, x in others.items()}
    data = SimpleNamespace(
        nefc=Recorded(np.array(worlds, np.int32)),
        nacon=Recorded([len(contacts["dim"])]),
        efc=SimpleNamespace(**arrays),
        contact=SimpleNamespace(**contacts),
        solver_niter=Recorded([2] * n),
        **others,
    )
    option = SimpleNamespace(timestep=Recorded([model.opt.timestep]), iterations=100)
    return SimpleNamespace(mjw_data=data, mj_model=model, mjw_model=SimpleNamespace(opt=option))
