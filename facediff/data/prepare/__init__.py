"""From the raw distribution of a data set to a corpus folder: ``facediff data prepare``.

One module per data set and nothing else: its ``plan(raw, *, …)`` scans the raw folder and returns a
:class:`~facediff.data.preparation.PreparationPlan`, and its keyword parameters are options of the command.
"""
