"""Where frames of a live performance go: one file for each protocol, registered by the scheme of its address."""
