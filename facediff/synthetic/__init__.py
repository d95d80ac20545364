"""The built-in corpus: synthetic speakers with heads made by code and speech from synthesisers.

It is synthetic, needs no licence and no download, and has the layout of BIWI's circulating copies on disk. See
:func:`generate`.
"""

from facediff.synthetic.corpus import FRAME_RATE, GENERATOR, UNIT, generate

__all__ = ["FRAME_RATE", "GENERATOR", "UNIT", "generate"]
