"""The parts of all reports: documents in every form, intervals and tests, and plots.

:mod:`~facediff.reporting.documents` turns one list of titles, tables and plots into Markdown, HTML, LaTeX and text;
:mod:`~facediff.reporting.statistics` has intervals and tests; :mod:`~facediff.reporting.drawing` draws with matplotlib.
Evaluation, benchmarks and studies define their numbers.
"""
