"""The built-in head: skin, eyes, mouth, ears and hair made by code, people who differ, and their rig."""
