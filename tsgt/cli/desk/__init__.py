"""Commands on recordings after the drive: ``process`` and ``evaluate``, with its reference and its report.

In comes a recording, perhaps with other set-up files and a reference; out go poses, figures of accuracy and a report.
"""
