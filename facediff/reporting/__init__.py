"""The parts of all reports: documents in every form, and intervals and tests.

:mod:`~facediff.reporting.documents` turns one list of titles and tables into Markdown, HTML, LaTeX and text;
:mod:`~facediff.reporting.statistics` has intervals and tests. Evaluation, benchmarks and studies define their numbers.
"""
