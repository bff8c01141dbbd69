"""The defects of `benchmarks/missions/planted_defects.py` can be planted, detected and removed."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from harness.missions.defects import Planting

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.fixture(scope="module")
def script() -> Iterator[ModuleType]:
    """Return the benchmark."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("missions.planted_defects")


@pytest.mark.parametrize(("key", "check"), [("angle", "journal"), ("offset", "time"), ("order", "replay")])
@pytest.mark.slow
def test_planted_defect_is_detected_and_removed(script: ModuleType, key: str, check: str) -> None:
    """Eight seconds suffice for these; the program is restored afterwards."""
    defect: Any = dataclasses.replace(script.DEFECTS[key], duration_s=8.0)
    planting = Planting()
    defect.plant(planting)
    places = planting.replaced[:]
    planting.undo()
    assert check in script.hunt(defect, seeds=1).checks
    assert all(owner.__dict__[name] is right for owner, name, right in places)


@pytest.mark.slow
def test_every_defect_replaces_existing_code(script: ModuleType) -> None:
    """The replaced attributes exist and are restored; the named tests exist. Also of the independent ones."""
    for defect in script.all_defects().values():
        planting = Planting()
        defect.plant(planting)
        places = [(owner, name, getattr(owner, name)) for owner, name, _ in planting.replaced]
        planting.undo()
        assert places
        assert all(owner.__dict__[name] is not wrong for owner, name, wrong in places)
        if defect.test:
            path, _, test = defect.test.partition("::")
            assert f"def {test}(" in (script.TESTS / path).read_text()
