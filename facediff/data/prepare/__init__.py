"""From the raw distribution of a data set to a corpus folder: ``facediff data prepare``.

One file per data set scans its raw folder and says what there is to do (:class:`~facediff.data.prepare.runner.Plan`);
the runner does it, in parallel, and can take up where it was stopped.
"""
