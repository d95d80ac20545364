"""What all reports are made with: documents in every form, intervals and tests, and plots.

:mod:`~facediff.reporting.documents` turns one list of titles, tables and plots into Markdown, HTML, LaTeX and text;
:mod:`~facediff.reporting.statistics` says how sure a number is; :mod:`~facediff.reporting.drawing` draws with
matplotlib. Evaluation, benchmarks and studies add what their numbers mean.
"""
