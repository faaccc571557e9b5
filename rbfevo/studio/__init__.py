"""The designer's brush: a local page on which a mesh is painted, its front is searched, and setups are pulled."""
