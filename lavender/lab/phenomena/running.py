"""Phenomenon by engine by case: engines of others in a process of their own, whose end is a note."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from lavender.base.apart import served
from lavender.base.apart.process import Ended, NoAnswer, Process, Raised
from lavender.base.arrays import number, several
from lavender.base.errors import CapabilityError, InputError, UnknownName, check_name
from lavender.lab.phenomena.engines import WAYS, Way, follow, make
from lavender.lab.phenomena.friction import FRICTION
from lavender.lab.phenomena.joints import JOINTS
from lavender.lab.phenomena.parts import Phenomenon, Record, Track, judged
from lavender.lab.phenomena.stacks import STACKS
from lavender.sim.scene import Scene

#: Name -> phenomenon, in the order of the table.
PHENOMENA: dict[str, Phenomenon] = {p.name: p for p in (*FRICTION, *JOINTS, *STACKS)}
MODULE = __name__  # whose `serve` the other process runs
LIMIT = 120.0  # s of wall time for one case
ROOM = 2**30  # bytes of one track


class Apart(Process):
    """A process that steps scenes; a new one after each that ended."""

    def __init__(self, limit: float = LIMIT) -> None:
        super().__init__(MODULE)
        self.limit = limit

    def track(self, way: Way, scene: Scene, seconds: float, interval: float) -> Track | str:
        """What the engine did, or why there is nothing."""
        cause = self.start()
        if cause:
            return f"its process does not start: {cause}"
        try:
            said, (time, place, turn, speed) = self.ask(
                [(way.name, scene, seconds, interval)], self.limit, ROOM
            )
            k, n = len(time), len(scene.bodies)
            return Track(
                time=time,
                positions=place.reshape(k, n, 3),
                quaternions=turn.reshape(k, n, 4),
                velocities=speed.reshape(k, n, 6),
                force=float(said["force"]),
                cpu=float(said["cpu"]),
                setting=str(said["setting"]),
            )
        except (NoAnswer, ValueError, KeyError, TypeError, AttributeError) as error:
            return f"its answer is no track: {error}"
        except Raised as error:
            return (
                str(error) if error.kind == CapabilityError.__name__ else f"it failed: {error.kind}: {error}"
            )
        except TimeoutError:
            return f"no answer within {self.limit:g} s"
        except Ended as end:
            return f"its process ended: {end}"


def serve(lifeline: int) -> None:
    """The other process: answer the questions of `Apart.track`, until they end."""
    served.serve(lifeline, lambda: _answer)


def _answer(message: Any) -> tuple[dict[str, Any], list[Any]]:
    name, scene, seconds, interval = message
    engine = make(WAYS[name], scene)
    try:
        found = follow(engine, seconds, interval)
    finally:
        engine.close()
    said = {"force": found.force, "cpu": found.cpu, "setting": found.setting}
    return said, [found.time, found.positions, found.quaternions, found.velocities]


def chosen(names: Sequence[str] = ()) -> list[Phenomenon]:
    """Phenomena by name, all without one.

    Raises
    ------
    UnknownName
        No such phenomenon.
    """
    names = several("names", names, "phenomena")
    for name in names:
        check_name("phenomenon", name, PHENOMENA)
    return [PHENOMENA[name] for name in dict.fromkeys(names or PHENOMENA)]


def ways(steppers: Sequence[str] | None = None, engines: Sequence[str] | None = None) -> list[Way]:
    """Ways by name of stepper or engine, or of one setting of them; of both all without a list.

    Raises
    ------
    UnknownName
        No such stepper or engine.
    """
    found: list[Way] = []
    for what, given, own in (("stepper", steppers, True), ("engine", engines, False)):
        some = [w for w in WAYS.values() if (w.module == "own") == own]
        names = {n for w in some for n in (w.name, w.name.split()[0])}
        for name in given if given is not None else ():
            if name not in names:
                raise UnknownName(what, name, sorted(names))
        found += [w for w in some if given is None or w.name in given or w.name.split()[0] in given]
    return found


def run(
    names: Sequence[str] = (),
    *,
    steppers: Sequence[str] | None = None,
    engines: Sequence[str] | None = (),
    parameters: Mapping[str, Any] | None = None,
    limit: float = LIMIT,
    show: Callable[[Record], None] = lambda record: None,
    keep: Callable[[Record, Track], None] = lambda record, track: None,
) -> list[Record]:
    """Measure phenomena.

    Parameters
    ----------
    names : sequence of str
        Of `PHENOMENA`; all without one.
    steppers, engines : sequence of str, optional
        Of `WAYS`; None: all. An engine that is missing, crashes, cannot build the scene or does not answer is a note
        in its record.
    parameters : mapping, optional
        One case in the place of each phenomenon's own.
    limit : float
        Wall time of one case in an engine of others [s].
    show : callable
        Called with every record as it comes.
    keep : callable
        Called with a record and the finite motion that it was measured of.

    Returns
    -------
    list of Record

    Raises
    ------
    UnknownName
        No such phenomenon, stepper, engine or parameter.
    InputError
        A parameter or limit outside its range, or neither stepper nor engine; nothing has run.
    """
    if limit != math.inf:
        limit = number("limit", limit, above=0.0)
    plan = [
        (p, case)
        for p in chosen(names)
        for case in map(p.values, p.cases if parameters is None else (parameters,))
    ]
    chosen_ways = ways(steppers, engines)
    if not chosen_ways:
        raise InputError("no stepper and no engine to measure; name one, or leave steppers to its default")
    found = []
    apart = Apart(limit)
    try:
        for way in chosen_ways:
            for record in _measure(way, plan, apart, keep):
                found.append(record)
                show(record)
    finally:
        apart.end()
    return found


def _measure(
    way: Way,
    plan: list[tuple[Phenomenon, dict[str, float]]],
    apart: Apart,
    keep: Callable[[Record, Track], None],
) -> Iterator[Record]:
    lack = way.missing()
    for phenomenon, case in plan:
        note = lack or next((way.cannot[x] for x in sorted(phenomenon.needs) if x in way.cannot), "")
        found = note or _one(way, phenomenon, case, apart)
        if isinstance(found, str):
            yield Record(phenomenon.name, way.name, case, note=found)
        else:
            record = judged(phenomenon, way.name, case, found)
            if not record.note:
                keep(record, found)
            yield record


def _one(way: Way, phenomenon: Phenomenon, case: dict[str, float], apart: Apart) -> Track | str:
    seconds = phenomenon.seconds(case)
    try:
        scene = phenomenon.scene(case, **way.scene)
        if way.module != "own":
            return apart.track(way, scene, seconds, phenomenon.interval)
        return follow(make(way, scene), seconds, phenomenon.interval)
    except (InputError, CapabilityError) as error:  # a stepper that does not take the scene
        return str(error)
