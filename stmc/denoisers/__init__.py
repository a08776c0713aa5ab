"""Networks that predict clean motion from noisy motion, a step and a text."""

from stmc.denoisers.mdm_smpl import MdmSmpl
from stmc.denoisers.protocol import Denoiser

__all__ = ["Denoiser", "MdmSmpl"]
