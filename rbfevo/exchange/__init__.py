"""Files about a setup's centers: displacements and weights that come in, parameters of other tools that go out."""
