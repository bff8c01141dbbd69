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

# What is started in the background of a script ignores Ctrl-C, and so would all programs that are tested.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

FIELD_DATA = Path(__file__).parents[2] / "shared" / "data" / "rts"

# How long an example takes says how busy the machine is, no more.
settings.register_profile("ci", deadline=None)
# For `make fuzz`. What fails stays in .hypothesis as it is: the next run without this profile makes it small, which
# may take longer than all the rest.
settings.register_profile(
    "fuzz", deadline=None, max_examples=4000, phases=(Phase.explicit, Phase.reuse, Phase.generate)
)
settings.load_profile("ci")


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
    """Undo what a command has set; a level of its own would hide events from the tests after it."""
    yield
    structlog.reset_defaults()


@pytest.fixture
def field_data() -> Path:
    """Folder of the real field data; a user's clone does not have it."""
    if not FIELD_DATA.is_dir():
        pytest.skip(f"the field data is not at {FIELD_DATA}")
    return FIELD_DATA
