"""Changes to finished animations: retargeting, blendshapes, expressiveness, procedural eyes and head motion."""
