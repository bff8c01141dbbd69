"""Fixtures of the unit tests."""

from __future__ import annotations

from harness.files.cli import tsgt  # noqa: F401 (a fixture)
