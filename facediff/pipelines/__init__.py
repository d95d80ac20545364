"""From recordings to animation files: one recording, a folder of them, or a stream."""
