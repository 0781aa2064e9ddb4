"""What `cqrun new` writes: scenes and plug-ins from templates, and a scene from a recording."""
