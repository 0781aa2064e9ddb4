"""From the files of a testing machine to a material: curves, fits of all laws, their comparison, and what to trust."""
