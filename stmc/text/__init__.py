"""Text encoders that condition a network, and their embeddings cached on disk.

Depends on pre-trained language models (through transformers) and files; independent of motion, timelines and denoisers.
Weights are loaded at first use, so that an encoder costs nothing to construct.
"""

from stmc.text.cached import Cached
from stmc.text.clip import Clip, ClipTokens
from stmc.text.empty import EmptyAsZeros
from stmc.text.language_models import MiniLM, Tokens
from stmc.text.pretrained import WeightsNotFound
from stmc.text.remembered import Remembered
from stmc.text.text_encoder import TextEncoder

__all__ = [
    "Cached",
    "Clip",
    "ClipTokens",
    "EmptyAsZeros",
    "MiniLM",
    "Remembered",
    "TextEncoder",
    "Tokens",
    "WeightsNotFound",
]
