"""One run: settings in, methods carried out, checkpoints, and the run directory out."""
