"""Packed corpora: a whole corpus as one Zarr store, a sixth of the size, read from a disk or from an address.

``layout`` says what lies where, ``stores`` fetches bytes, ``shards`` decodes chunks, ``reader`` gives clips to the data
modules, ``packing`` writes a store and ``unpacking`` gives the corpus folder back.
"""
