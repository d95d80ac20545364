"""From the raw distribution of a data set to a corpus folder: ``facediff data prepare``.

One file per data set scans its raw folder and returns a :class:`~facediff.data.prepare.runner.PreparationPlan`. The
runner writes what is planned, in parallel; it can be stopped and run again at any time.
"""
