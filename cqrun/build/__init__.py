"""From a scene to the engine's model and back: particles, regions, rest shapes, actuation, and the checks that need particles."""
