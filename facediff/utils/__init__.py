"""Helpers that every package may use: files, jobs, pickles."""
