"""From the raw distribution of a data set to a corpus folder: ``facediff data prepare``.

One file per data set scans its raw folder and plans what to write (:class:`~facediff.data.prepare.runner.Plan`); the
runner writes it, in parallel, and can be stopped and run again at any time.
"""
