"""3D viewer: its program and pages."""
