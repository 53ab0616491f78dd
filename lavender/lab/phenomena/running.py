"""Measure phenomena in engines. Third-party engines run in another process; if it ends, the record has a note."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from lavender.base import subprocesses
from lavender.base.arrays import check_float, check_sequence
from lavender.base.errors import CapabilityError, InputError, UnknownName, check_name
from lavender.base.subprocesses import ProcessBackend, ProcessEnded, RemoteError
from lavender.lab.phenomena.engines import ENGINE_VARIANTS, EngineVariant, make_engine, record_track
from lavender.lab.phenomena.friction import FRICTION_PHENOMENA
from lavender.lab.phenomena.joints import JOINT_PHENOMENA
from lavender.lab.phenomena.parts import Phenomenon, Record, Track, measure_track
from lavender.lab.phenomena.stacks import STACK_PHENOMENA
from lavender.sim.scene import Scene

#: Name -> phenomenon, in the order of the table.
PHENOMENA: dict[str, Phenomenon] = {
    p.name: p for p in (*FRICTION_PHENOMENA, *JOINT_PHENOMENA, *STACK_PHENOMENA)
}
TRACK_TIME_LIMIT = 120.0  # [s] A third-party engine that takes longer for one case is killed.
MAX_TRACK_SIZE = 2**30  # [bytes] A process that sends a larger track is killed.


class EngineProcess(ProcessBackend):
    """Steps scenes in another process, which is restarted if it ended; `limit` [s] is the time limit of one track."""

    def __init__(self, limit: float = TRACK_TIME_LIMIT) -> None:
        super().__init__(record_track_of_engine)
        self.limit = limit

    def record_track(
        self, variant: EngineVariant, scene: Scene, seconds: float, interval: float
    ) -> Track | str:
        """Return the motion that the engine computes, or the reason why there is none."""
        try:
            self.start()
        except ProcessEnded as error:
            return f"its process does not start: {error}"
        try:
            answer, (time, positions, quaternions, velocities) = self.call_function(
                variant.name, scene, seconds, interval, timeout=self.limit, max_bytes=MAX_TRACK_SIZE
            )
            k, n = len(time), len(scene.bodies)
            return Track(
                time=time,
                positions=positions.reshape(k, n, 3),
                quaternions=quaternions.reshape(k, n, 4),
                velocities=velocities.reshape(k, n, 6),
                force=float(answer["force"]),
                cpu=float(answer["cpu"]),
                setting=str(answer["setting"]),
            )
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            return f"its answer is not a track: {error}"
        except RemoteError as error:
            return (
                str(error) if error.kind == CapabilityError.__name__ else f"it failed: {error.kind}: {error}"
            )
        except TimeoutError:
            return f"no answer within {self.limit:g} s"
        except ProcessEnded as error:
            return f"its process ended: {error}"


def record_track_of_engine(name: str, scene: Scene, seconds: float, interval: float) -> subprocesses.Answer:
    """Step a scene with the engine of that name, in the process of `EngineProcess`."""
    engine = make_engine(ENGINE_VARIANTS[name], scene)
    try:
        track = record_track(engine, seconds, interval)
    finally:
        engine.close()
    answer = {"force": track.force, "cpu": track.cpu, "setting": track.setting}
    return answer, [track.time, track.positions, track.quaternions, track.velocities]


def select_phenomena(names: Sequence[str] = ()) -> list[Phenomenon]:
    """Return phenomena by name, all of them if no name is given.

    Raises
    ------
    UnknownName
        The phenomenon is not known.
    """
    names = check_sequence("names", names, "phenomena")
    for name in names:
        check_name("phenomenon", name, PHENOMENA)
    return [PHENOMENA[name] for name in dict.fromkeys(names or PHENOMENA)]


def select_variants(
    steppers: Sequence[str] | None = None, engines: Sequence[str] | None = None
) -> list[EngineVariant]:
    """Return the variants with the given names of steppers and engines; None selects all of either kind.

    The name of an engine selects all of its settings, the name of a variant selects one.

    Raises
    ------
    UnknownName
        The stepper or engine is not known.
    """
    found: list[EngineVariant] = []
    for kind, requested, own in (("stepper", steppers, True), ("engine", engines, False)):
        candidates = [w for w in ENGINE_VARIANTS.values() if (w.module == "own") == own]
        names = {n for w in candidates for n in (w.name, w.name.split()[0])}
        for name in requested if requested is not None else ():
            if name not in names:
                raise UnknownName(kind, name, sorted(names))
        found += [
            w
            for w in candidates
            if requested is None or w.name in requested or w.name.split()[0] in requested
        ]
    return found


def run(
    names: Sequence[str] = (),
    *,
    steppers: Sequence[str] | None = None,
    engines: Sequence[str] | None = (),
    parameters: Mapping[str, Any] | None = None,
    limit: float = TRACK_TIME_LIMIT,
    show: Callable[[Record], None] = lambda record: None,
    keep: Callable[[Record, Track], None] = lambda record, track: None,
) -> list[Record]:
    """Measure phenomena.

    Parameters
    ----------
    names : sequence of str
        Keys of `PHENOMENA`; all of them if empty.
    steppers, engines : sequence of str, optional
        Names in `ENGINE_VARIANTS`; None: all. If an engine is missing, crashes, cannot build the scene or does not
        answer, its record has a note.
    parameters : mapping, optional
        One case that replaces the cases of each phenomenon.
    limit : float
        Wall time [s] of one case in a third-party engine.
    show : callable
        Called with every record when it is complete.
    keep : callable
        Called with a record and the finite motion from which it was measured.

    Returns
    -------
    list of Record

    Raises
    ------
    UnknownName
        A phenomenon, stepper, engine or parameter is not known.
    InputError
        A parameter or limit is outside its range, or neither a stepper nor an engine is named; nothing has run.
    """
    if limit != math.inf:
        limit = check_float("limit", limit, above=0.0)
    plan = [
        (p, case)
        for p in select_phenomena(names)
        for case in map(p.complete_parameters, p.cases if parameters is None else (parameters,))
    ]
    selected = select_variants(steppers, engines)
    if not selected:
        raise InputError(
            "neither steppers nor engines are named: name at least one, or leave steppers at its default"
        )
    found = []
    process = EngineProcess(limit)
    try:
        for variant in selected:
            for record in _measure_variant(variant, plan, process, keep):
                found.append(record)
                show(record)
    finally:
        process.close()
    return found


def _measure_variant(
    variant: EngineVariant,
    plan: list[tuple[Phenomenon, dict[str, float]]],
    process: EngineProcess,
    keep: Callable[[Record, Track], None],
) -> Iterator[Record]:
    """Measure all cases of the plan in one engine variant; a case that it cannot run gets a note."""
    reason = variant.explain_missing()
    for phenomenon, case in plan:
        note = reason or next(
            (variant.cannot[x] for x in sorted(phenomenon.needs) if x in variant.cannot), ""
        )
        found = note or _simulate_case(variant, phenomenon, case, process)
        if isinstance(found, str):
            yield Record(phenomenon.name, variant.name, case, note=found)
        else:
            record = measure_track(phenomenon, variant.name, case, found)
            if not record.note:
                keep(record, found)
            yield record


def _simulate_case(
    variant: EngineVariant, phenomenon: Phenomenon, case: dict[str, float], process: EngineProcess
) -> Track | str:
    """Simulate one case and return its track, or the reason of a failure; third-party engines run in `process`."""
    seconds = phenomenon.seconds(case)
    try:
        scene = phenomenon.build_scene(case, **variant.scene)
        if variant.module != "own":
            return process.record_track(variant, scene, seconds, phenomenon.interval)
        return record_track(make_engine(variant, scene), seconds, phenomenon.interval)
    except (InputError, CapabilityError) as error:  # The stepper does not support the scene.
        return str(error)
