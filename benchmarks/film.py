"""`python -m benchmarks film`: one phenomenon in several engines beside each other, as pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click
import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.cli.options import parameters_of
from lavender.io.stored import writable
from lavender.lab.phenomena import chosen, run
from lavender.lab.phenomena.parts import Phenomenon, Record, Track, Values
from lavender.sim.engine import Film, Simulation
from lavender.sim.engine.picture import picture_suffix, save_picture

FRAMES = 40  # of an animation, about
SIZE = 2.0  # inch, of one engine's picture
TURN, TILT = 0.25, 0.1  # rad, of the eye


def save_film(
    phenomenon: Phenomenon, case: Values, tracks: Mapping[str, Track], path: Path, magnify: float = 1.0
) -> Path:
    """Write a picture of what each engine did of one case.

    Parameters
    ----------
    phenomenon : Phenomenon
    case : its parameters
    tracks : name of an engine -> its track
    path : path
        As `lavender.engine.picture.save_picture` takes it.
    magnify : float
        Distances from the first track are shown so many times as large.

    Raises
    ------
    InputError
        No track, a path that cannot be written, another suffix.
    """
    if not tracks:
        raise InputError("no engine gave a motion to film")
    scene = phenomenon.scene(case)
    header = Simulation(scene).start_film().header
    films: dict[str, Film] = {}
    first = next(iter(tracks.values()))
    for name, track in tracks.items():
        film = films[name] = Film(header)
        base = _at(first, track.time)
        places = base + magnify * (track.positions - base)
        for time, place, turn in zip(track.time, places, track.quaternions, strict=True):
            film.add(float(time), {"solver": 0.0, "positions": place, "quaternions": turn})
    rate = max(1, min(12, int(FRAMES / max(track.time[-1] for track in tracks.values()))))
    return save_picture(films, path, turn=TURN, tilt=TILT, size=SIZE, rate=rate)


def _at(track: Track, time: FloatArray) -> FloatArray:
    """Positions (len(time), n, 3) [m] at these times, between two looks by a straight line."""
    k, n = track.positions.shape[:2]
    flat = track.positions.reshape(k, -1)
    found = np.stack([np.interp(time, track.time, column) for column in flat.T], axis=1)
    return found.reshape(len(time), n, 3)


@click.command("film")
@click.argument("name")
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--steppers", default="impulses newton", show_default=True, help="With commas.")
@click.option("--engines", default="", help="Engines of others, with commas.")
@click.option(
    "--set", "parameters", multiple=True, metavar="NAME=VALUE", help="A parameter of the phenomenon."
)
@click.option("--magnify", type=click.FloatRange(min=1.0), default=1.0, show_default=True,
              help="Show distances from the first engine so many times as large.")  # fmt: skip
def command(
    name: str,
    out: Path,
    steppers: str,
    engines: str,
    parameters: tuple[str, ...],
    magnify: float,
) -> None:
    """The phenomenon NAME as each engine does it, beside each other: .gif, .mp4 (animations), .png, .svg (strips)."""
    writable(out)
    picture_suffix(out)
    (phenomenon,) = chosen([name])
    case = parameters_of(parameters) if parameters else dict(phenomenon.cases[0])
    tracks: dict[str, Track] = {}

    def keep(record: Record, track: Track) -> None:
        tracks[record.engine] = track

    some = {
        what: [word.strip() for word in text.split(",") if word.strip()]
        for what, text in (("steppers", steppers), ("engines", engines))
    }
    found = run([name], **some, parameters=case, keep=keep)
    click.echo(save_film(phenomenon, found[0].case, tracks, out, magnify))
