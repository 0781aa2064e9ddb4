"""What `cqrun new` writes: scenes, and a plug-in of each kind with a scene that uses it.

Each file is complete and runs as it is. jobs/new/ writes it under the user's name in place of its own.
"""
