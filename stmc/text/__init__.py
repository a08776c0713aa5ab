"""Texts as numbers: the encoders a network can be conditioned on, and their embeddings cached on disk.

Knows pre-trained language models (through transformers) and files; knows nothing of motion, timelines or denoisers.
Weights are loaded when they are first needed, so an encoder costs nothing to construct.
"""

from stmc.text.cached import Cached
from stmc.text.clip import Clip, ClipTokens
from stmc.text.empty import EmptyAsZeros
from stmc.text.language_models import MiniLM, Tokens
from stmc.text.pretrained import WeightsNotFound
from stmc.text.text_encoder import TextEncoder

__all__ = ["Cached", "Clip", "ClipTokens", "EmptyAsZeros", "MiniLM", "TextEncoder", "Tokens", "WeightsNotFound"]
