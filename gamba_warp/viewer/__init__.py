"""The 3D viewer: its program and the pages that hold it."""
