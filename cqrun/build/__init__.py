"""From a scene to the engine's model and back, and the checks that need particles."""
