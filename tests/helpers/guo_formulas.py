"""What the evaluator of Guo et al. does with motions, captions and their embeddings, anew and slowly."""

from pathlib import Path

import numpy as np
import torch
from helpers import guo_files
from helpers.guo_files import WIDTH, WORDS
from scipy.linalg import sqrtm

from stmc.text.glove import PARTS_OF_SPEECH


def slow_words(folder: Path, caption: str) -> tuple[np.ndarray, np.ndarray, int]:
    """`WordVectorizer` of the published code, and what its data set does with it."""
    vectors, kinds = np.load(folder / "our_vab_data.npy"), {"walk": "Act_VIP", "arm": "Body_VIP", "raise": "Act_VIP"}
    kinds["slowly"] = "Desc_VIP"
    tokens = caption.split(" ")
    tokens = tokens if len(tokens) < 20 else tokens[:20]
    tokens = ["sos/OTHER", *tokens, "eos/OTHER"]
    length = len(tokens)
    tokens += ["unk/OTHER"] * (22 - length)
    words, spoken = np.zeros((22, WIDTH)), np.zeros((22, 15))
    for place, token in enumerate(tokens):
        word, kind = token.split("/")
        known = word in WORDS
        words[place] = vectors[WORDS.index(word if known else "unk")]
        kind = kinds.get(word, kind) if known else "OTHER"
        spoken[place, PARTS_OF_SPEECH.index(kind) if kind in PARTS_OF_SPEECH else 14] = 1
    return words, spoken, length


def slow_motions(rows: list[torch.Tensor], longest: int = 196) -> np.ndarray:
    """Each by itself: normalised, with zeros up to `longest` frames."""
    mean, std = np.linspace(-0.1, 0.1, 263), np.linspace(0.2, 0.6, 263)
    network, found = guo_files.network(), []
    for row in rows:
        padded = np.zeros((1, longest, 263))
        padded[0, : len(row)] = (row.numpy() - mean) / std
        found.append(network.motions(torch.from_numpy(padded).float(), torch.tensor([len(row)]))[0].numpy())
    return np.array(found)


def slow_texts(folder: Path, captions: list[str]) -> np.ndarray:
    network, found = guo_files.network(), []
    for caption in captions:
        words, kinds, length = slow_words(folder, caption)
        inputs = (torch.from_numpy(words[None]).float(), torch.from_numpy(kinds[None]).float(), torch.tensor([length]))
        found.append(network.texts(*inputs)[0].numpy())
    return np.array(found)


def slow_fid(one: np.ndarray, other: np.ndarray) -> float:
    first, second = (np.cov(each.astype(np.float64), rowvar=False) for each in (one, other))
    means = one.mean(axis=0) - other.mean(axis=0)
    return float(means @ means + np.trace(first + second - 2 * np.real(sqrtm(first @ second))))


def slow_pairs(count: int, pairs: int, seed: int):
    random = np.random.RandomState(seed)
    return random.choice(count, pairs, replace=False), random.choice(count, pairs, replace=False)
