"""What holds for all tests."""
# Before NumPy: it tells OpenBLAS to use one thread, as in every program of this package.
import sphstereo_ros  # noqa: F401
