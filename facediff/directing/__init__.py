"""Changes to a finished take: expressiveness by region, and procedural blinks, gaze and head sway."""
