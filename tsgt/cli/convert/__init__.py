"""Commands that convert recordings: ``import`` from other formats, ``export`` to them, ``merge`` with the stations' journals.

In: files of other programs, or a recording. Out: a recording, or files for other programs.
"""
