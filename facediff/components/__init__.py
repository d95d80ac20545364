"""The replaceable parts of a system: one folder per kind, one class per file.

A component works in ``dim`` channels and never sees a vertex, so that it serves any topology; only a
``mesh_encoder``, which makes these channels of a mesh's motion, does. A new component is one file that registers its
class: ``@registry.decoder.register("my_decoder")``.
"""
