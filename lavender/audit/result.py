"""Hold the result of an audit: errors and verdicts of every step, sentences, tables, files and the page."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from lavender.audit.bodies import find_bodies
from lavender.audit.page import AuditCounts, ResultPage, StepSizes, make_audit_page
from lavender.audit.pieces import (
    AUDIT_VERDICTS,
    N_WORST_WORLDS,
    NOT_JUDGED,
    WORST_ROW_ERRORS,
    Piece,
    Prediction,
    StepState,
    Worst,
)
from lavender.audit.provenance import describe_provenance, format_provenance
from lavender.audit.rigid_laws import Slide, StepCauses
from lavender.audit.simulated_worlds import Divergence, Runs, can_any_geoms_collide
from lavender.base.arrays import FloatArray, check_choice
from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.diagnostics.forces import CONTACT, ContactForces, contact_forces
from lavender.io.contact_friction import find_friction
from lavender.io.mujoco import read_gaps
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.npz import write_npz
from lavender.io.start_states import VECTOR
from lavender.io.stored import prepare_step_folder, write_arrays, write_text
from lavender.judge.residuals import AT_FLOOR, CLOSE, DEFAULT_THRESHOLD, UNCONVERGED, WRONG
from lavender.report.text import (
    format_count,
    format_percent,
    format_size,
    format_speed,
    split_row_unit,
)

PAIR_HEADS = [
    "bodies", "steps", "mean force [N]", "median error [N]", "99 % error [N]", "largest error [N]",
    "sum determined", "contacts determined",
]  # fmt: skip
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
QUANTILE_NAMES = ("50 %", "90 %", "99 %", "99.9 %", "largest error")
SAVED_KINDS = ("worst", "contact")
#: Outcomes of a step of an engine that claims that its solve converged, or that it did not.
OUTCOMES = (
    "claimed and right",
    "claimed and wrong",
    "not claimed but right",
    "not claimed and wrong",
    "claimed with numbers that are not finite",
    "not claimed, not finite",
)


@dataclass(eq=False)
class Audit:
    """Result of `audit`."""

    runs: Runs
    engine: str
    # (len(WORST_ROW_ERRORS), worlds, steps): errors of the worst row of each step; NaN if it was not judged.
    numbers: FloatArray
    # (worlds, steps) int: indices in `AUDIT_VERDICTS`; -1 if the audit was stopped before the step.
    verdict: Any
    # (worlds, steps) int: rows, and contacts that have rows; 0 if the step was not judged.
    rows: Any
    contacts: Any
    can_touch: bool = True  # Whether the model has geoms that can collide.
    threshold: float = (
        DEFAULT_THRESHOLD  # [m/s] Velocity error up to which an answer is close enough.
    )
    # [m/s] The headline counts the steps with a larger velocity error that rounding does not explain.
    error_limit: float | None = None
    # Sentences about the differences from a simulation of the model as it is, and warnings.
    notes: list[str] = field(default_factory=list)
    # (worlds, steps) int: the engine's claims, 1 if it calls the solve converged, 0 if not, -1 without a claim; None
    # if it makes none.
    converged: Any = None
    # Row name (without numbers of contacts) -> number of steps that stopped before convergence with this worst row, and
    # its largest error [m/s].
    where: dict[str, tuple[int, float]] = field(default_factory=dict)
    worst: list[Worst] = field(default_factory=list)
    divergences: list[Divergence] = field(default_factory=list)
    is_stopped: bool = False  # Whether Ctrl-C stopped the audit, or workers were lost.
    # MuJoCo's own warnings, and how often each occurred.
    engine_warnings: Counter[str] = field(default_factory=Counter)
    # States before steps with contact, if the audit keeps them; in the order of worlds and steps.
    contact_states: list[StepState] = field(default_factory=list)
    n_dropped: int = 0  # Number of constraint rows for which the engine had no memory.
    lost_digits: list[tuple[float, float]] = field(default_factory=list)  # See `Piece`.
    prediction: Prediction = field(default_factory=Prediction)
    step_forces: list[pd.DataFrame] = field(default_factory=list)  # See `Piece.forces`.
    # Causes of the worst steps, then of the step with the largest difference from the rigid laws; of MuJoCo only.
    causes: list[StepCauses] = field(default_factory=list)
    slide: Slide | None = None  # The fastest contact that would not slide by the rigid laws.
    against: Audit | None = None  # Result of another model on the same states.
    provenance: dict[str, Any] = field(default_factory=dict)  # Result of `describe_provenance`.
    folder: Path = Path("lavender-audit")  # To which `write` wrote.

    @classmethod
    def with_size(cls, runs: Runs, engine: str, *, has_claims: bool = False, **more: Any) -> Audit:
        """Create the result of an audit before its first step."""
        shape = runs.worlds, runs.steps
        rows, contacts = np.zeros((2, *shape), int)
        numbers = np.full((len(WORST_ROW_ERRORS), *shape), np.nan)
        verdict, claims = np.full((2, *shape), -1, np.int8)
        result = cls(runs, engine, numbers, verdict, rows, contacts, notes=list(runs.notes), **more)
        result.converged = claims if has_claims else None
        result.provenance = describe_provenance(runs.model, runs.name, engine)
        if runs.model is not None:
            result.can_touch = can_any_geoms_collide(runs.mj, runs.model)
        if runs.against is not None:
            name, model = runs.against
            other = replace(runs, name=name, model=model, against=None, notes=())
            result.against = cls.with_size(other, engine, **more)
        return result

    def add_piece(self, piece: Piece, keep: int | None) -> None:
        """Add the results of judged steps, and keep the worst (`Judging.keep`)."""
        # Enlarge the arrays for steps of a loop of unknown length and number of worlds.
        size = self.verdict.shape
        at = (piece.world, piece.step)
        worlds, steps = (
            max(n, int(np.max(x, initial=-1)) + 1) for n, x in zip(size, at, strict=True)
        )
        if (worlds, steps) != size:
            more = ((0, worlds - size[0]), (0, steps - size[1]))
            self.numbers = np.pad(self.numbers, ((0, 0), *more), constant_values=np.nan)
            self.verdict = np.pad(self.verdict, more, constant_values=-1)
            self.rows, self.contacts = np.pad(self.rows, more), np.pad(self.contacts, more)
            if self.converged is not None:
                self.converged = np.pad(self.converged, more, constant_values=-1)
            self.runs = replace(self.runs, worlds=worlds, steps=steps)
        self.numbers[:, piece.world, piece.step] = piece.numbers
        self.verdict[at], self.rows[at], self.contacts[at] = (
            piece.verdict,
            piece.rows,
            piece.contacts,
        )
        if self.converged is not None and piece.converged is not None:
            self.converged[at] = piece.converged
        for i, name in piece.where:
            count, largest = self.where.get(name, (0, 0.0))
            self.where[name] = count + 1, max(largest, float(piece.numbers[0, i]))
        ranked = sorted([*self.worst, *piece.worst], key=lambda w: (-w.velocity, w.world, w.step))
        if keep is None:  # The worst step of each world.
            worst = {w.world: w for w in reversed(ranked)}
            ranked = [w for w in ranked if worst[w.world] is w]
        self.worst[:] = ranked[: N_WORST_WORLDS if keep is None else keep]
        self.contact_states.extend(piece.contact_states)
        self.engine_warnings.update(piece.engine_warnings)
        self.divergences[:] = sorted([*self.divergences, *piece.divergences])
        self.n_dropped += piece.n_dropped
        self.lost_digits.extend(piece.lost_digits)
        self.prediction = self.prediction.merge(piece.prediction)
        if piece.forces is not None and len(piece.forces):
            self.step_forces.append(piece.forces)
        if self.against is not None and piece.against is not None:
            self.against.add_piece(piece.against, keep)

    # -- counts --------------------------------------------------------------------------------------------

    @property
    def is_judged(self) -> Any:
        """(worlds, steps) bool: whether the error is finite."""
        return (self.verdict >= 0) & (self.verdict < NOT_JUDGED)

    @property
    def is_unconverged(self) -> Any:
        """(worlds, steps) bool: whether the solve stopped before convergence, or the answer is wrong."""
        return np.isin(self.verdict, [AUDIT_VERDICTS.index(word) for word in (UNCONVERGED, WRONG)])

    @property
    def n_judged(self) -> int:
        """Number of steps judged."""
        return int(np.count_nonzero(self.is_judged))

    @property
    def n_unjudged(self) -> int:
        """Number of steps that were requested and not judged."""
        return self.verdict.size - self.n_judged

    @property
    def n_processed(self) -> int:
        """Number of steps that the audit processed."""
        return int(np.count_nonzero(self.verdict >= 0))

    @property
    def n_diverged(self) -> int:
        """Number of steps in which a world diverged: one for each world that diverged."""
        return len(self.divergences)

    @property
    def max_velocity_error(self) -> float:
        """Largest velocity error that rounding does not explain, of the steps judged [m/s]."""
        return AuditCounts(self).largest

    @property
    def n_above_limit(self) -> int:
        """Number of steps with a velocity error above `error_limit` that rounding does not explain."""
        return 0 if self.error_limit is None else AuditCounts(self).above

    @property
    def judged_sizes(self) -> StepSizes:
        """Rows and contacts of the steps judged."""
        return StepSizes(self.rows[self.is_judged], self.contacts[self.is_judged], self.can_touch)

    @property
    def is_unmet(self) -> bool:
        """Whether a world diverged, steps were not judged or exceed the limit, rows were lost, or contact is rare."""
        lost = self.n_diverged or self.n_unjudged or self.n_above_limit or self.n_dropped
        return bool(lost) or not self.judged_sizes.has_enough_contact

    @property
    def outcome(self) -> Any:
        """(worlds, steps) int: indices in `OUTCOMES`; -1 without a claim."""
        if self.converged is None:
            return np.full(self.verdict.shape, -1)
        claimed = self.converged == 1
        judged = np.where(self.is_unconverged, 1, 0) + np.where(claimed, 0, 2)
        outcome = np.where(self.verdict == NOT_JUDGED, np.where(claimed, 4, 5), judged)
        return np.where(self.converged < 0, -1, outcome)

    @property
    def claim_counts(self) -> dict[str, int]:
        """Number of steps with each outcome."""
        outcome = self.outcome
        return {name: int(np.count_nonzero(outcome == i)) for i, name in enumerate(OUTCOMES)}

    def has_exact_solves(self, divergence: Divergence) -> bool:
        """Return whether every step of a world that diverged was solved, so that its solver is not the cause.

        A step is solved if its error is at the round-off floor or below `DEFAULT_THRESHOLD` [m/s]. The last step does
        not count if its state or unconstrained acceleration was too large before it was solved.
        """
        selection = divergence.world, slice(0, divergence.step + (not divergence.is_outside))
        verdict = self.verdict[selection]
        close = (verdict == AUDIT_VERDICTS.index(CLOSE)) & (
            self.numbers[0][selection] <= DEFAULT_THRESHOLD
        )
        return bool(np.all(close | (verdict == AUDIT_VERDICTS.index(AT_FLOOR))))

    # -- sentences -----------------------------------------------------------------------------------------

    @property
    def headline(self) -> list[str]:
        """Result in sentences: the size of the error, when and where, and the cause."""
        counts = AuditCounts(self)
        return [counts.verdict, *counts.sentences]

    @property
    def advice(self) -> list[str]:
        """Sentences with consequences and remedies, below the tables of a terminal."""
        lines = list[str]()
        if not self.judged_sizes.has_enough_contact:
            few = f"Only {self.judged_sizes.contact_phrase}: too few to rate the solver"
            lines.append(f"{few}; start from other states (--states).")
        if self.n_dropped:
            lines.append(
                f"The engine had no memory for {self.n_dropped} constraint rows and dropped them: its answers solve "
                "problems without these rows. Allocate more with --njmax."
            )
        predicted = self.prediction
        if predicted.first is not None:
            world, step = predicted.first
            lines.append(
                f"In {predicted.different} of {format_count(predicted.steps, 'step')} the bodies did not move as the "
                f"judged answer predicts, by up to {format_size(predicted.largest)} m/s or rad/s, first in world "
                f"{world}, step {step}: the model or the state was changed within the step, for example by a callback, "
                "or MuJoCo has a term that is unknown here. Verdicts of these steps do not count."
            )
        lost = self._count_lost_digits()
        if lost["steps"]:
            text = (
                f"In {format_count(lost['steps'], 'step')} the forces lose up to {lost['digits']:.0f} of their digits, "
                "because R of a row is far below the diagonal of J M^-1 J^T."
            )
            if lost["moved_by_forces"]:
                exact = (
                    f"The acceleration is exact to {format_size(lost['acceleration_error'])} m/s"
                )
                text += f" {exact}; the steps, which use the forces, are not."
            lines.append(text)
        if self.engine_warnings:
            counted = self.engine_warnings.most_common()
            texts = "; ".join(f"{text} ({format_count(n, 'time')})" for text, n in counted)
            lines.append(f"MuJoCo's own warnings: {texts}.")
        return [*lines, *self.notes]

    def _count_lost_digits(self) -> dict[str, Any]:
        """Count the steps with forces that have lost digits; `acceleration_error` is the largest one [m/s]."""
        errors = [error for _, error in self.lost_digits if np.isfinite(error)]
        return {
            "steps": len(self.lost_digits),
            "digits": max((n for n, _ in self.lost_digits), default=0.0),
            "moved_by_forces": len(errors),
            "acceleration_error": max(errors, default=0.0),
        }

    def compare_in_words(self) -> str:
        """Return a sentence with the counts of the other model on the same states; empty without one."""
        if self.against is None:
            return ""
        other = self.against
        both = self.is_judged & self.against.is_judged
        own, its = (x.numbers[0][both] for x in (self, other))
        better = int((own < its).sum())
        worse = int((own > its).sum())
        n = int(both.sum())
        less, more = (format_percent(x, max(n, 1), 1) for x in (better, worse))
        return (
            f"Against {other.runs.name}, on the same {format_count(n, 'state')}: the error is smaller in {less} of the "
            f"steps and larger in {more}; {int(self.is_unconverged.sum())} of its solves stopped before convergence or "
            f"are wrong, and {int(other.is_unconverged.sum())} of the other model's."
        )

    # -- tables --------------------------------------------------------------------------------------------

    @property
    def errors(self) -> pd.DataFrame:
        """Quantiles of the errors over all steps judged, and over unconverged and wrong ones."""
        return _tabulate_quantiles(
            {
                "velocity [m/s]": self.numbers[0][self.is_judged],
                "impulse [N s]": self.numbers[1][self.is_judged],
                "velocity, unconverged [m/s]": self.numbers[0][self.is_unconverged],
            }
        )

    @property
    def worst_rows(self) -> pd.DataFrame:
        """The worst rows of steps that stopped before convergence or are wrong, most frequent first."""
        rows = []
        for name, (n, x) in sorted(self.where.items(), key=lambda entry: -entry[1][0]):
            row, unit = split_row_unit(name)
            rows.append((row, n, format_speed(x, unit)))
        return pd.DataFrame(rows, columns=["worst row", "steps", "largest error"])

    @property
    def diverged(self) -> pd.DataFrame:
        """The step in which each world diverged."""
        rows = [
            (
                d.cause,
                d.world,
                d.step,
                float(self.numbers[0, d.world, d.step]),
                "exact" if self.has_exact_solves(d) else "not exact",
            )
            for d in self.divergences
        ]
        return pd.DataFrame(
            rows, columns=["too large", "world", "step", "error [m/s]", "solves until then"]
        )

    @property
    def worst_steps(self) -> pd.DataFrame:
        """The worlds of the worst steps, which are written to files."""
        rows = []
        for i, w in enumerate(self.worst, 1):
            row, unit = split_row_unit(w.where)
            rows.append((f"worst_{i}.npz", w.world, w.step, format_speed(w.velocity, unit), row))
        return pd.DataFrame(rows, columns=["file", "world", "step", "error", "worst row"])

    @property
    def claims(self) -> pd.DataFrame:
        """Number of steps and worlds with each outcome of a claim, and errors."""
        rows = []
        outcome = self.outcome
        for i, name in enumerate(OUTCOMES):
            here = outcome == i
            n = int(here.sum())
            if n:
                errors = self.numbers[0][here & self.is_judged]
                sizes = (
                    np.quantile(errors, (0.5, 1.0)).tolist() if len(errors) else [np.nan, np.nan]
                )
                share = format_percent(n, int((outcome >= 0).sum()), 1)
                rows.append((name, n, share, int(np.count_nonzero(here.any(axis=1))), *sizes))
        heads = [
            "claim and verdict",
            "steps",
            "share",
            "worlds",
            "median [m/s]",
            "largest error [m/s]",
        ]
        return pd.DataFrame(rows, columns=heads)

    @property
    def comparison(self) -> pd.DataFrame:
        """Errors and counts of this model and of the other one on the same states."""
        if self.against is None:
            return pd.DataFrame()
        other = self.against
        both = self.is_judged & self.against.is_judged
        names = f"{self.runs.name} [m/s]", f"against {other.runs.name} [m/s]"
        return _tabulate_quantiles(
            {names[0]: self.numbers[0][both], names[1]: other.numbers[0][both]}
        )

    # -- files ---------------------------------------------------------------------------------------------

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write `records.npz`, the worst steps as `worst/worst_1.npz` etc., and `states.npz`.

        `page.write` writes the page.

        `records.npz` holds `velocity` [m/s], `impulse` [N s], `relative`, `floor`, `verdict`, `rows`, `contacts` (each
        (worlds, steps)), `verdicts`, `diverged`, rows of (world, step), and of an engine with claims `converged`.
        `states.npz` holds the states before the worst steps, one row each, by the engine's names; for MuJoCo
        `state` is their mjSTATE_INTEGRATION. `forces.csv` has a row for each contact of many steps (`forces`).
        """
        folder = self.folder = Path(folder)
        worst = prepare_step_folder(folder / "worst", replace=True)
        for i, w in enumerate(self.worst, 1):
            gap = self._read_gaps(w)
            write_npz(w.problem, worst / f"worst_{i}.npz", impulse=w.impulse, gap=gap)
        self.save_states("worst", folder / "states.npz")
        if AuditCounts(self).slides and self.slide is not None:
            write_arrays(folder / "slip.npz", {VECTOR: self.slide.state[None]})
        records = dict(zip(WORST_ROW_ERRORS, self.numbers, strict=True))
        records |= {"verdict": self.verdict, "verdicts": np.array(AUDIT_VERDICTS)}
        records |= {"rows": self.rows, "contacts": self.contacts}
        records["diverged"] = np.array([(d.world, d.step) for d in self.divergences], int).reshape(
            -1, 2
        )
        if self.converged is not None:
            records["converged"] = self.converged
        if self.against is not None:
            records["against"] = self.against.numbers[0]
        write_arrays(folder / "records.npz", records)
        write_text(folder / "forces.csv", self.forces.to_csv(index=False))

    def _read_gaps(self, worst: Worst) -> FloatArray | None:
        """Return the gaps of a worst step of MuJoCo itself [m]; None for other engines."""
        if self.engine != "mujoco" or self.runs.model is None or VECTOR not in worst.state:
            return None
        mj, model = self.runs.mj, self.runs.model
        data = mj.MjData(model)
        mj.mj_setState(model, data, worst.state[VECTOR], mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_forward(model, data)
        return read_gaps(data, worst.problem)

    @cached_property
    def _forces_of_worst(self) -> list[tuple[int, Worst, ContactForces]]:
        """Number, step and contact forces of the worst steps that have a solution; none without a model."""
        found = []
        for i, w in enumerate(self.worst if self.runs.model is not None else (), 1):
            dt = float(self.runs.model.opt.timestep)
            pairs = partial(find_bodies, import_mujoco(), self.runs.model)
            friction = partial(find_friction, self.runs.model)
            with contextlib.suppress(InputError):  # A step without a solution has no exact forces.
                forces = contact_forces(w.problem, w.impulse, dt=dt, pairs=pairs, friction=friction)
                found.append((i, w, forces))
        return found

    @property
    def worst_forces(self) -> pd.DataFrame:
        """Contact forces of the worst steps [N], as `lavender.contact_forces`."""
        frames = []
        for i, w, forces in self._forces_of_worst:
            table = forces.table
            for k, (head, value) in enumerate(
                {"file": f"worst_{i}.npz", "world": w.world, "step": w.step}.items()
            ):
                table.insert(k, head, value)
            frames.append(table)
        return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()

    @cached_property
    def forces(self) -> pd.DataFrame:
        """Contacts with their forces and errors [N] of the worst steps and of up to about 2000 others, evenly spaced.

        The columns are `world`, `step` and those of `lavender.ContactForces.by_contact`. Empty without a model.
        """
        tables = [*self.step_forces]
        known = {at for table in tables for at in zip(table["world"], table["step"], strict=True)}
        for _, w, forces in self._forces_of_worst:
            if (w.world, w.step) not in known:
                table = forces.by_contact
                table.insert(0, "world", w.world)
                table.insert(1, "step", w.step)
                tables.append(table)
        if not tables:
            return pd.DataFrame()
        table = pd.concat(tables, ignore_index=True)
        return table.sort_values(["world", "step"], kind="stable", ignore_index=True)

    @property
    def pair_forces(self) -> pd.DataFrame:
        """Normal forces of each pair of bodies and their errors [N] over the steps of `forces`, the largest first."""
        rows = []
        for pair, own in self.forces.groupby("bodies", sort=False) if len(self.forces) else ():
            sums = own.groupby(["world", "step"])[["pair force [N]", "pair error [N]"]].first()
            known = sums.dropna().to_numpy()
            sizes = np.full(4, np.nan)
            if len(known):
                quantiles = np.quantile(known[:, 1], (0.5, 0.99, 1.0), method="higher")
                sizes = np.concatenate([[known[:, 0].mean()], quantiles])
            alone = int((own["determined"] == CONTACT).sum())
            shares = (len(known), len(sums)), (alone, len(own))
            rows.append((pair, len(sums), *sizes, *(format_percent(*x) for x in shares)))
        rows.sort(key=lambda row: -np.nan_to_num(row[2], nan=-1.0))
        return pd.DataFrame(rows, columns=PAIR_HEADS)

    @property
    def forces_note(self) -> str:
        """Sentences on the steps of `forces`."""
        solved = len(self.forces[["world", "step"]].drop_duplicates()) if len(self.forces) else 0
        total = int(np.count_nonzero(self.contacts[self.is_judged]))
        return f"{solved} of {format_count(total, 'step')} with contact compared with an exact solution."

    def save_states(self, kind: str, path: str | os.PathLike[str]) -> int:
        """Write states before steps to a file that `--states` reads, and return their number.

        Parameters
        ----------
        kind : {"worst", "contact"}
            Steps with the largest errors (`worst`), or with contact (`contact_states`).
        path : path of an .npz
        """
        check_choice("kind", kind, SAVED_KINDS)
        kept: Sequence[Worst | StepState] = self.worst if kind == "worst" else self.contact_states
        names = kept[0].state if kept else ()
        arrays = {name: np.array([entry.state[name] for entry in kept]) for name in names}
        labels = {
            name: np.array([getattr(entry, name) for entry in kept], int)
            for name in ("world", "step")
        }
        write_arrays(Path(path), arrays | labels)
        return len(kept)

    @property
    def totals(self) -> dict[str, Any]:
        """Totals, as `numbers.json` holds them."""
        runs, unconverged = self.runs, self.is_unconverged
        divergences = [d._asdict() | {"exact": self.has_exact_solves(d)} for d in self.divergences]
        totals = {
            "head": self.headline,
            "notes": self.advice,
            "engine": self.engine,
            "model": runs.name,
            "worlds": runs.worlds,
            "steps": runs.steps,
            "seed": runs.seed,
            "spread": runs.spread,
            "threshold": self.threshold,
            "judged": self.n_judged,
            "unjudged": self.n_unjudged,
            "diverged": self.n_diverged,
            "unconverged": int(unconverged.sum()),
            "wrong": int((self.verdict == AUDIT_VERDICTS.index(WRONG)).sum()),
            "worlds_unconverged": int(unconverged.any(axis=1).sum()),
            "largest": self.max_velocity_error,
            "error_limit": self.error_limit,
            "above_limit": self.n_above_limit,
            "dropped_rows": self.n_dropped,
            "divergences": divergences,
            **self.judged_sizes.as_dict,
            "engine_warnings": dict(self.engine_warnings),
            "stopped": self.is_stopped,
            "provenance": self.provenance,
            "prediction": self.prediction._asdict(),
            "lost_digits": self._count_lost_digits(),
            "forces": self.pair_forces.to_dict("records"),
        }
        if self.converged is not None:
            totals["claims"] = self.claim_counts
        if self.against is not None:
            totals["against"] = self.against.totals
        return totals

    @property
    def page(self) -> ResultPage:
        """Page with the result in sentences, figures and tables, as `lavender audit` writes it."""
        counts = AuditCounts(self)
        rows = [(name, n, format_percent(n, max(counts.n, 1))) for name, n in counts.classes]
        classes = pd.DataFrame(rows, columns=["error of the worst row", "steps", "share"])
        short = [self.comparison, self.claims, classes, self.worst_rows.head(3), self.worst_steps]
        short.append(self.pair_forces.head(3))
        last = format_provenance(self.provenance)
        return ResultPage(partial(make_audit_page, self), self.totals, short, self.is_stopped, last)


def _tabulate_quantiles(errors: dict[str, Any]) -> pd.DataFrame:
    """Build the table of `QUANTILES` of some errors; columns without a finite error are left out."""
    known = {name: x[np.isfinite(x)] for name, x in errors.items()}
    columns = {
        name: np.quantile(x, QUANTILES, method="higher") for name, x in known.items() if len(x)
    }
    return pd.DataFrame({"quantile": QUANTILE_NAMES, **columns} if columns else {})
