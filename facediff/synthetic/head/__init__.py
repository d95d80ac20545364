"""The head of the second edition: skin, eyes, mouth, ears and hair made by code, people who differ, and their rig."""
