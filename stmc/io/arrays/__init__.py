"""Arrays in untrusted files, read without executing any code in them."""

from stmc.io.arrays.checkpoints import check_checkpoint
from stmc.io.arrays.joblib_files import read_joblib
from stmc.io.arrays.numpy_files import ArraysError, Header, npz_headers, read_npy, read_npz, read_npz_chunks
from stmc.io.arrays.pickles import read_pickle, read_places

__all__ = [
    "ArraysError",
    "Header",
    "check_checkpoint",
    "npz_headers",
    "read_joblib",
    "read_npy",
    "read_npz",
    "read_npz_chunks",
    "read_pickle",
    "read_places",
]
