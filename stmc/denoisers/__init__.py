"""Networks that predict motion, or its noise, from noisy motion, a diffusion step and a text."""

from stmc.denoisers.attention_scores import recorded_attention
from stmc.denoisers.denoiser import Denoiser
from stmc.denoisers.flow_mdm import FlowMdm
from stmc.denoisers.mdm import MdmDecoder, MdmEncoder
from stmc.denoisers.mdm_smpl import MdmSmpl
from stmc.denoisers.motion_diffuse import MotionDiffuse
from stmc.denoisers.network import Network, as_network

__all__ = [
    "Denoiser",
    "FlowMdm",
    "MdmDecoder",
    "MdmEncoder",
    "MdmSmpl",
    "MotionDiffuse",
    "Network",
    "as_network",
    "recorded_attention",
]
