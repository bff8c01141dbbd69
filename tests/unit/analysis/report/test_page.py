"""The report's page with untrusted text."""

from __future__ import annotations

from tsgt.analysis.report import Headline, render_page
from tsgt.analysis.report.page import Section, Table


def test_text_is_escaped() -> None:
    """Names of files, sources and events are shown literally; none becomes a tag or ends an attribute."""
    evil = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>`<b>`"
    tables = (Table(evil, (evil, evil), ((evil, evil),)), Table("", (), ((evil, evil),)))
    text = render_page(
        evil,
        Headline(((evil, evil),), (evil,), (evil,), (evil,)),
        None,
        [Section(title=evil, text=(evil,), tables=tables)],
        {},
    )
    assert "&lt;script&gt;" in text
    for tag in ("<script", "<img", "<b>"):
        assert tag not in text
