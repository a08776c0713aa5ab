"""The papers' networks as their equations say, one sample at a time and frame by frame: an oracle that is slow.

In float64, with numpy alone, from named weights. Knows no batches and no padding: a sample is all there is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

Seen = Callable[[int, int], bool]
"""(query, key) → whether the query's token attends to the key's."""

erf = np.vectorize(math.erf)


class Weights:
    """Arrays by their names below `prefix`, and the two layers that every network is made of."""

    def __init__(self, named: Mapping[str, np.ndarray], prefix: str = "") -> None:
        self._named, self._prefix = named, prefix

    def __getitem__(self, name: str) -> np.ndarray:
        return self._named[self._prefix + name]

    def __contains__(self, name: str) -> bool:
        return any(each.startswith(self._prefix + name) for each in self._named)

    def of(self, prefix: str) -> Weights:
        return Weights(self._named, f"{self._prefix}{prefix}.")

    def layers(self, prefix: str) -> list[Weights]:
        """Those below `prefix`.0, `prefix`.1, … as long as there are any."""
        found: list[Weights] = []
        while f"{prefix}.{len(found)}." in self:
            found.append(self.of(f"{prefix}.{len(found)}"))
        return found

    def linear(self, name: str, x: np.ndarray) -> np.ndarray:
        return x @ self[f"{name}.weight"].T + self._named.get(f"{self._prefix}{name}.bias", 0.0)

    def norm(self, name: str, x: np.ndarray) -> np.ndarray:
        """Layer norm (Ba et al. 2016)."""
        centred = x - x.mean(axis=-1, keepdims=True)
        deviation = np.sqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
        return self[f"{name}.weight"] * centred / deviation + self[f"{name}.bias"]


def gelu(x: np.ndarray) -> np.ndarray:
    return x * (1 + erf(x / math.sqrt(2))) / 2


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def silu(x: np.ndarray) -> np.ndarray:
    return x * sigmoid(x)


def softmax(x: np.ndarray, axis: int) -> np.ndarray:
    shares = np.exp(x - x.max(axis=axis, keepdims=True))
    return shares / shares.sum(axis=axis, keepdims=True)


def place(position: int, width: int) -> np.ndarray:
    """Sines and cosines in turn (Vaswani et al. 2017, section 3.5)."""
    angles = [position / 10000 ** (2 * (i // 2) / width) for i in range(width)]
    return np.array([math.cos(angle) if i % 2 else math.sin(angle) for i, angle in enumerate(angles)])


def placed(tokens: np.ndarray) -> np.ndarray:
    return np.stack([token + place(position, len(token)) for position, token in enumerate(tokens)])


def always(query: int, key: int) -> bool:
    return True


def attended(query: np.ndarray, key: np.ndarray, value: np.ndarray, seen: Seen = always) -> np.ndarray:
    """softmax(q k / sqrt(d)) v of one head, query by query (Vaswani et al. 2017, Eq. 1)."""
    rows = []
    for i, asked in enumerate(query):
        keys = [j for j in range(len(key)) if seen(i, j)]
        shares = softmax(np.array([asked @ key[j] for j in keys]) / math.sqrt(len(asked)), axis=0)
        rows.append(sum(share * value[j] for share, j in zip(shares, keys, strict=True)))
    return np.stack(rows)


def by_heads(heads: int, attention: Callable, *projected: np.ndarray) -> np.ndarray:
    """Each head on its own share of the channels; what they find, side by side."""
    split = [np.split(each, heads, axis=-1) for each in projected]
    return np.concatenate([attention(*(each[head] for each in split)) for head in range(heads)], axis=-1)


def attention(weights: Weights, heads: int, tokens: np.ndarray, memory: np.ndarray) -> np.ndarray:
    matrices = np.split(weights["in_proj_weight"], 3)
    biases = np.split(weights["in_proj_bias"], 3)
    projected = [x @ m.T + b for x, m, b in zip((tokens, memory, memory), matrices, biases, strict=True)]
    return weights.linear("out_proj", by_heads(heads, attended, *projected))


def feedforward(weights: Weights, tokens: np.ndarray) -> np.ndarray:
    return weights.linear("linear2", gelu(weights.linear("linear1", tokens)))


def pre_norm(weights: Weights, heads: int, tokens: np.ndarray) -> np.ndarray:
    """A transformer's layer that normalises before each half."""
    normal = weights.norm("norm1", tokens)
    tokens = tokens + attention(weights.of("self_attn"), heads, normal, normal)
    return tokens + feedforward(weights, weights.norm("norm2", tokens))


def post_norm(weights: Weights, heads: int, tokens: np.ndarray) -> np.ndarray:
    """A transformer's layer that normalises behind each half, as the first of them did."""
    tokens = weights.norm("norm1", tokens + attention(weights.of("self_attn"), heads, tokens, tokens))
    return weights.norm("norm2", tokens + feedforward(weights, tokens))


def decoding(weights: Weights, heads: int, tokens: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """A layer that also attends to a memory."""
    tokens = weights.norm("norm1", tokens + attention(weights.of("self_attn"), heads, tokens, tokens))
    tokens = weights.norm("norm2", tokens + attention(weights.of("multihead_attn"), heads, tokens, memory))
    return weights.norm("norm3", tokens + feedforward(weights, tokens))


def step_token(weights: Weights, t: int, width: int) -> np.ndarray:
    """Of all transformers here: two layers on the sinusoids of the step."""
    return weights.linear("2", silu(weights.linear("0", place(t, width))))


# Denoisers ------------------------------------------------------------------------------------------------------------


def mdm_smpl(weights: Weights, heads: int, x: np.ndarray, t: int, words: np.ndarray) -> np.ndarray:
    """STMC, section 3.4 and appendix D: tokens of step, words, registers and frames through pre-norm layers."""
    text = weights.of("tx_embedding")
    words = text.norm("3", text.linear("2", gelu(text.linear("0", words))))
    step = step_token(weights.of("timestep_encoder.time_embed"), t, words.shape[1])
    tokens = placed(np.vstack([step, words, weights["registers"], weights.linear("skel_embedding", x)]))
    for layer in weights.layers("seqTransEncoder.layers"):
        tokens = pre_norm(layer, heads, tokens)
    return weights.linear("to_skel_layer", tokens[-len(x) :])


def mdm_encoder(weights: Weights, heads: int, x: np.ndarray, t: int, word: np.ndarray) -> np.ndarray:
    """MDM (Tevet et al. 2023), section 3: step and text are one token in front of the frames."""
    text = weights.linear("embed_text", word)
    step = step_token(weights.of("embed_timestep.time_embed"), t, text.shape[-1])
    tokens = placed(np.vstack([step + text, weights.linear("input_process.poseEmbedding", x)]))
    for layer in weights.layers("seqTransEncoder.layers"):
        tokens = post_norm(layer, heads, tokens)
    return weights.linear("output_process.poseFinal", tokens[1:])


def mdm_decoder(
    weights: Weights, heads: int, x: np.ndarray, t: int, words: np.ndarray, leading: str | None
) -> np.ndarray:
    """MDM's decoder: frames attend to the words, each with the step added; a token may stand in front of them."""
    memory = weights.linear("embed_text", words)
    step = step_token(weights.of("embed_timestep.time_embed"), t, memory.shape[-1])
    memory = memory + step
    front = {None: memory[:0], "step": step[None], "step_and_text": memory[:1]}[leading]
    tokens = placed(np.vstack([front, weights.linear("input_process.poseEmbedding", x)]))
    for layer in weights.layers("seqTransDecoder.layers"):
        tokens = decoding(layer, heads, tokens, memory)
    return weights.linear("output_process.poseFinal", tokens[len(front) :])


def motion_diffuse(
    weights: Weights, heads: int, reading_heads: int, x: np.ndarray, t: int, words: np.ndarray
) -> np.ndarray:
    """MotionDiffuse (Zhang et al. 2022), section 3.3: the noise. The first word stands for the text."""
    words = weights.linear("text_pre_proj", words)
    for layer in weights.layers("textTransEncoder.layers"):
        words = post_norm(layer, reading_heads, words)
    words = weights.norm("text_ln", words)
    half = weights["sequence_embedding"].shape[1] // 2
    angles = np.array([t * 10000 ** (-i / half) for i in range(half)])
    step = weights.linear("time_embed.0", np.concatenate([np.cos(angles), np.sin(angles)]))
    style = weights.linear("time_embed.2", silu(step)) + weights.linear("text_proj.0", words[0])
    tokens = weights.linear("joint_embed", x) + weights["sequence_embedding"][: len(x)]
    for block in weights.layers("temporal_decoder_blocks"):
        normal = block.norm("sa_block.norm", tokens)
        tokens = tokens + efficient(block.of("sa_block"), heads, normal, normal, style)
        normal, memory = block.norm("ca_block.norm", tokens), block.norm("ca_block.text_norm", words)
        tokens = tokens + efficient(block.of("ca_block"), heads, normal, memory, style)
        tokens = tokens + stylised(block.of("ffn.proj_out"), feedforward(block.of("ffn"), tokens), style)
    return weights.linear("out", tokens)


def efficient(weights: Weights, heads: int, tokens: np.ndarray, memory: np.ndarray, style: np.ndarray) -> np.ndarray:
    """Efficient attention (Shen et al. 2021): softmax(q) over channels, softmax(k) over the memory, no n x n table."""

    def one(query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        context = softmax(key, axis=0).T @ value
        return softmax(query, axis=1) @ context

    query, key, value = (weights.linear(name, x) for name, x in (("query", tokens), ("key", memory), ("value", memory)))
    return stylised(weights.of("proj_out"), by_heads(heads, one, query, key, value), style)


def stylised(weights: Weights, tokens: np.ndarray, style: np.ndarray) -> np.ndarray:
    """MotionDiffuse's stylization block: scale and shift of a norm from step and text."""
    scale, shift = np.split(weights.linear("emb_layers.1", silu(style)), 2)
    return weights.linear("out_layers.2", silu(weights.norm("norm", tokens) * (1 + scale) + shift))


def flow_mdm(
    weights: Weights,
    heads: int,
    window: int,
    absolute: bool,
    x: np.ndarray,
    t: int,
    words: np.ndarray,
    segment: list,
    conditioning: str = "pccat",
) -> np.ndarray:
    """FlowMDM (Barquero et al. 2024), section 3: blended positional encodings, pose-centric cross-attention.

    `words[segment[i]]` is the text of frame i. `absolute`: positions within segments, which alone are seen; else rotary
    positions, and sight across segments. Another `conditioning` is one of the ablations in section 4.1.
    """
    text = weights.linear("embed_text", words)
    step = step_token(weights.of("embed_timestep.time_embed"), t, text.shape[1])
    condition = np.stack([step + text[number] for number in segment])
    encoder = weights.of("seqTransEncoder")
    frames = encoder.linear("project_in", weights.linear("input_process.poseEmbedding", x))
    if absolute:
        scale, width = encoder["pos_emb.absolute.scale"], frames.shape[1]
        frames = frames + np.stack([scale * _halves(i - segment.index(n), width) for i, n in enumerate(segment)])

    def seen(query: int, key: int) -> bool:
        return abs(query - key) <= window and (not absolute or segment[query] == segment[key])

    layers, kinds = encoder.layers("attn_layers.layers"), (*CONDITIONINGS[conditioning], "inner")
    for layer, kind in zip(layers, itertools.cycle(kinds), strict=False):
        normal, inside = layer.norm("0.0", frames), layer.of("1")
        if kind == "inner":
            frames = frames + inside.linear("ff.3", gelu(inside.linear("ff.0.0", normal)))
        else:
            asking, asked = conditioned(inside, kind, normal, condition)
            frames = frames + attention_to(inside, heads, asking, asked, seen, not absolute)
    frames = encoder.norm("attn_layers.final_norm", frames)
    return weights.linear("output_process.poseFinal", encoder.linear("project_out", frames))


CONDITIONINGS = {"pccat": ("eq. 3",), "sat": ("eq. 2",), "cat": ("poses", "cross")}
"""What a layer attends by, for each way in which the condition comes to the frames."""


def conditioned(weights: Weights, kind: str, poses: np.ndarray, condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What makes queries, and what makes keys and values. Eq. 3: the condition enters the queries alone; Eq. 2: all."""
    if kind in ("poses", "cross"):
        return poses, poses if kind == "poses" else condition
    both = weights.linear("custom_query_fn", np.hstack([poses, condition]))
    return both, poses if kind == "eq. 3" else both


def attention_to(
    weights: Weights, heads: int, asking: np.ndarray, asked: np.ndarray, seen: Seen, turned: bool
) -> np.ndarray:
    """Attention with rotary positions where frames are `turned`."""
    query, key, value = weights.linear("to_q", asking), weights.linear("to_k", asked), weights.linear("to_v", asked)

    def one(query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        return attended(*(rotary(each) if turned else each for each in (query, key)), value, seen)

    return weights.linear("to_out", by_heads(heads, one, query, key, value))


def rotary(tokens: np.ndarray, turned: int = 32) -> np.ndarray:
    """Rotary positions (Su et al. 2021) of the first channels: pairs (i, i + half) as complex numbers."""
    half = turned // 2
    pairs = tokens[:, :half] + 1j * tokens[:, half:turned]
    angles = np.array([[m * 10000 ** (-i / half) for i in range(half)] for m in range(len(tokens))])
    pairs = pairs * np.exp(1j * angles)
    return np.hstack([pairs.real, pairs.imag, tokens[:, turned:]])


def _halves(position: int, width: int) -> np.ndarray:
    angles = np.array([position * 10000 ** (-2 * i / width) for i in range(width // 2)])
    return np.concatenate([np.sin(angles), np.cos(angles)])


# Evaluators -----------------------------------------------------------------------------------------------------------


def tmr_encoder(weights: Weights, heads: int, rows: np.ndarray) -> list[np.ndarray]:
    """TMR (Petrovich et al. 2023), section 3.1, after ACTOR: what comes out at the learned tokens."""
    tokens = placed(np.vstack([weights["tokens"], weights.linear("projection", rows)]))
    for layer in weights.layers("seqTransEncoder.layers"):
        tokens = post_norm(layer, heads, tokens)
    return list(tokens[: len(weights["tokens"])])


def tmr_decoder(weights: Weights, heads: int, latent: np.ndarray, frames: int) -> np.ndarray:
    """Positions that attend to each other and to the latent, whichever motion or text it is of."""
    tokens = placed(np.zeros((frames, len(latent))))
    for layer in weights.layers("seqTransDecoder.layers"):
        tokens = decoding(layer, heads, tokens, latent[None])
    return weights.linear("final_layer", tokens)


def guo_movements(weights: Weights, frames: np.ndarray) -> np.ndarray:
    """Guo et al. (2022): two convolutions over time, each halving the frames."""
    for name in ("main.0", "main.3"):
        kernel, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
        padded = np.pad(frames, ((1, 1), (0, 0)))
        frames = np.stack(
            [np.einsum("oik,ki->o", kernel, padded[i : i + 4]) + bias for i in range(0, len(padded) - 3, 2)]
        )
        frames = np.where(frames > 0, frames, 0.2 * frames)
    return weights.linear("out_net", frames)


def guo_reader(weights: Weights, rows: np.ndarray) -> np.ndarray:
    """Gated recurrent units (Cho et al. 2014) from both ends, and two layers on their last states."""
    inputs, states = weights.linear("input_emb", rows), []
    for end, suffix in enumerate(("", "_reverse")):
        state = weights["hidden"][end, 0]
        for row in inputs[::-1] if end else inputs:
            given = row @ weights[f"gru.weight_ih_l0{suffix}"].T + weights[f"gru.bias_ih_l0{suffix}"]
            kept = state @ weights[f"gru.weight_hh_l0{suffix}"].T + weights[f"gru.bias_hh_l0{suffix}"]
            (reset, update, new), (old_reset, old_update, old) = np.split(given, 3), np.split(kept, 3)
            share = sigmoid(update + old_update)
            state = share * state + (1 - share) * np.tanh(new + sigmoid(reset + old_reset) * old)
        states.append(state)
    hidden = weights.norm("output_net.1", weights.linear("output_net.0", np.concatenate(states)))
    return weights.linear("output_net.3", np.where(hidden > 0, hidden, 0.2 * hidden))
