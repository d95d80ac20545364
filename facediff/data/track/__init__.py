"""Tracking faces in videos: the tracker, and the corpus that is made of its tracks."""
