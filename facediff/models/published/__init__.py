"""The field's published methods, one file each, as published: their quirks are options with names."""
