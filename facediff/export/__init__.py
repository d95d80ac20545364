"""Takes to the files of other programs: meshes that move, point caches, videos, tables of weights."""
