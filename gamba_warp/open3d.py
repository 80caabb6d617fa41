"""The one place that imports Open3D, which on a bare Linux host lacks a system library."""

import ctypes
import sys
from types import ModuleType


def import_open3d() -> ModuleType:
    """Returns the ``open3d`` module.

    Its Linux wheel wants ``libusb-1.0.so.0`` from the system; ``libusb-package`` carries the
    library, and loading it first satisfies the linker without root.
    """
    if "open3d" not in sys.modules and sys.platform == "linux":
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            pass  # the system's own library may be there; else the import says what is missing
    import open3d

    return open3d
