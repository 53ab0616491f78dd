"""A pytest plug-in with which an engine measures itself on scenes of known motion.

    pytest --phenomena my_engine:Adapter
    pytest --phenomena my_engine:Adapter --phenomena-names stick,slide,lift

`Adapter(scene)` steps a `lavender.sim.scene.Scene`; it has the attributes and methods of
`lavender.lab.phenomena.engines.Stepping`: `dt`, `step()`, and `get_state()` -> positions (n, 3) [m], quaternions (n, 4)
w x y z, velocities (n, 6) [m/s, rad/s]. It raises `lavender.CapabilityError` for a scene that it cannot build; the test
is then skipped with this reason. Each case of each phenomenon is a test. It fails if a quantity exceeds its bound, with
the quantity, its value, its bound and the reason of the bound.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from lavender.lab.phenomena.parts import Phenomenon, Record


class PhenomenonExceeded(Exception):
    """Quantities of a phenomenon exceed their bounds; the text names them."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the plug-in."""
    group = parser.getgroup("lavender", "scenes of known motion")
    group.addoption(
        "--phenomena",
        metavar="MODULE:ADAPTER",
        help="Measure this engine on scenes of known motion; ADAPTER(scene) steps a lavender Scene.",
    )
    group.addoption(
        "--phenomena-names",
        metavar="A,B,...",
        help="Phenomena to measure; default: all (lavender phenomena --list).",
    )


def pytest_collection_modifyitems(
    session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
) -> None:
    """Add a test for each case of each phenomenon."""
    adapter_name = config.getoption("--phenomena")
    if adapter_name is None:
        return
    from lavender.base.errors import UnknownName
    from lavender.lab.phenomena import select_phenomena

    names = config.getoption("--phenomena-names")
    try:
        phenomena = select_phenomena([name.strip() for name in names.split(",")] if names else [])
    except UnknownName as error:
        raise pytest.UsageError(str(error)) from None
    adapter = _load_adapter(adapter_name, config.rootpath)
    for phenomenon in phenomena:
        for i in range(len(phenomenon.cases)):
            items.append(
                PhenomenonItem.from_parent(
                    session, name=f"{phenomenon.name}[{i}]", phenomenon=phenomenon, case=i, adapter=adapter
                )
            )


def _load_adapter(name: str, root: Path) -> Any:
    """Return the adapter "module:attribute"; modules in the root folder of the tests are found."""
    module_name, colon, attribute = name.partition(":")
    if not (module_name and colon and attribute):
        raise pytest.UsageError(f"--phenomena is {name!r}; MODULE:ADAPTER is needed")
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    try:
        adapter = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise pytest.UsageError(f"--phenomena {name}: {error}") from None
    if not callable(adapter):
        raise pytest.UsageError(f"--phenomena {name} is not callable; ADAPTER(scene) is needed")
    return adapter


class PhenomenonItem(pytest.Item):
    """One case of a phenomenon in the engine of an adapter."""

    def __init__(self, *, phenomenon: Phenomenon, case: int, adapter: Any, **more: Any) -> None:
        super().__init__(**more)
        self.phenomenon, self.adapter = phenomenon, adapter
        self.values = phenomenon.complete_parameters(phenomenon.cases[case])
        self.add_marker("phenomenon")

    def runtest(self) -> None:
        """Simulate the case and compare every quantity with its bound."""
        from lavender.base.errors import CapabilityError
        from lavender.lab.phenomena.engines import record_track
        from lavender.lab.phenomena.parts import measure_track

        scene = self.phenomenon.build_scene(self.values)
        try:
            engine = self.adapter(scene)
        except CapabilityError as error:
            pytest.skip(f"the engine cannot build the scene: {error}")
        try:
            track = record_track(engine, self.phenomenon.seconds(self.values), self.phenomenon.interval)
        finally:
            if hasattr(engine, "close"):
                engine.close()
        record = measure_track(self.phenomenon, type(engine).__name__, self.values, track)
        failures = list(self._describe_failures(record))
        if failures:
            raise PhenomenonExceeded("\n".join([self._describe_case(), *failures]))

    def _describe_case(self) -> str:
        """Return the title, the parameters and the exact motion of the case."""
        values = ", ".join(f"{name} = {x:g}" for name, x in self.values.items())
        return f"{self.phenomenon.title} ({values})\nexact motion: {self.phenomenon.truth}"

    def _describe_failures(self, record: Record) -> Iterator[str]:
        """Yield a line for each quantity above its bound."""
        if record.note:
            yield record.note
            return
        for quantity in self.phenomenon.quantities:
            value = record.get_value(quantity.name)
            if value > quantity.bound:
                yield (
                    f"{quantity.name} is {value:.3g} {quantity.unit}; at most {quantity.bound:g} {quantity.unit} "
                    f"passes: {quantity.text}"
                )

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the text of a failure without a traceback of the plug-in."""
        if isinstance(excinfo.value, PhenomenonExceeded):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the heading of the report."""
        return self.path, None, f"phenomenon {self.name}"


def pytest_configure(config: pytest.Config) -> None:
    """Declare the marker of the tests."""
    config.addinivalue_line("markers", "phenomenon: a scene of known motion (lavender)")
