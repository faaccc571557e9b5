"""The process in which VTK and meshio read and write meshes: its start, its messages, and a module for each idea.

VTK's readers end the whole process on some damaged files, and meshio's print, leave, or never come back. So they run in
a process of their own, which needs NumPy, VTK and meshio only: it answers with what the file holds, waits for the moved
points, and writes them; whatever happens to it, its parent (`rbfevo/meshes/foreign.py`) lives on.
"""
