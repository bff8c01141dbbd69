"""Fixtures for all tests: coroutine tests on virtual time, leak checks, the field data."""

from __future__ import annotations

import asyncio
import inspect
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import structlog
from hypothesis import Phase, settings

import tsgt.cli  # noqa: F401 (sets how many threads numpy has, before it is loaded)
from tsgt.simulation.kernel import run_virtual

if TYPE_CHECKING:
    from collections.abc import Iterator

# A background job of a script ignores Ctrl-C, and so would every program that the tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

TESTS = Path(__file__).parent
FIELD_DATA = TESTS.parents[1] / "shared" / "data" / "rts"

# No deadline: how long an example takes depends on the load of the machine.
# Derandomised: the same examples in each run; `make fuzz` looks for new ones.
settings.register_profile("ci", deadline=None, derandomize=True)
# For `make fuzz`: a failing example is kept in .hypothesis without shrinking, which may take longer than all the rest;
# the next run without this profile shrinks it.
settings.register_profile(
    "fuzz", deadline=None, max_examples=4000, phases=(Phase.explicit, Phase.reuse, Phase.generate)
)
settings.load_profile("ci")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run real processes or other people's programs as slow."""
    for item in items:
        if item.path.relative_to(TESTS).parts[0] in {"process", "interop"}:
            item.add_marker(pytest.mark.slow)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test on virtual time, and fail it if a task leaks."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def checked() -> None:
        await pyfuncitem.obj(**arguments)
        leaked = asyncio.all_tasks() - {asyncio.current_task()}
        assert not leaked, f"tasks still running at the end of the test: {leaked}"

    run_virtual(checked)
    return True


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    """Restore the logging configuration: a level that a command sets would hide events from later tests."""
    yield
    structlog.reset_defaults()


@pytest.fixture(scope="session")
def field_data() -> Path:
    """Folder of the real field data; a user's clone does not have it."""
    if not FIELD_DATA.is_dir():
        pytest.skip(f"the field data is not at {FIELD_DATA}")
    return FIELD_DATA
