"""Initial guesses of a maneuver: solved maneuvers, screw motions, and solves that reach the target."""
