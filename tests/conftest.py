"""Fixtures for all tests: coroutine tests on virtual time, leak checks, the field data."""

from __future__ import annotations

import asyncio
import inspect
from pathlib import Path
from typing import Any

import looptime
import pytest

FIELD_DATA = Path(__file__).parents[2] / "shared" / "data" / "rts"


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test on a loop whose time jumps to the next timer, and fail it if a task leaks."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def checked() -> None:
        await pyfuncitem.obj(**arguments)
        leaked = asyncio.all_tasks() - {asyncio.current_task()}
        assert not leaked, f"tasks still running at the end of the test: {leaked}"

    def new_loop() -> asyncio.AbstractEventLoop:
        loop: Any = looptime.new_event_loop()
        loop.setup_looptime(start=0, end=86_400)
        return loop  # type: ignore[no-any-return]

    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(checked())
    return True


@pytest.fixture
def field_data() -> Path:
    """Folder of the real field data; a user's clone does not have it."""
    if not FIELD_DATA.is_dir():
        pytest.skip(f"the field data is not at {FIELD_DATA}")
    return FIELD_DATA
