"""The figures of the report, drawn on figures of matplotlib that are handed in.

In: a figure and what it shows. Out: nothing but the drawing. Style and axes are those of `tsgt.analysis.figures`.
"""
