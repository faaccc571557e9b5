"""Does bounded potential predict what max-norm steps gain on objectives that were not used to choose it?"""
