"""Changes to finished animations: retargeting, blendshapes, procedural motion, expressiveness."""
