"""TMR beside the golden numbers: what its networks must not depend on, losses in closed form, run directories, and
training from a cache to a table of what it can find."""

import csv
import dataclasses
import json
import math

import pytest
import torch
from helpers.motions import walking
from helpers.scripts import script
from helpers.tiny_model import Hashes
from helpers.toy_data import LAYOUT, LetterCounts, cache
from torch.nn.functional import normalize, smooth_l1_loss

import stmc
from stmc.data.cache import Cache, Clip
from stmc.diffusion.statistics import Statistics
from stmc.diffusion.tensors import mask, pad
from stmc.evaluators import Evaluator, GuoEvaluator, Posterior, Tmr
from stmc.motion.representation import SmplRepresentation
from stmc.run import CONFIG, WEIGHTS, RunError, load_evaluator, save_evaluator
from stmc.training import Objective, Pairs, TmrObjective
from stmc.training.data.balanced_batches import BalancedBatches
from stmc.training.data.batches import ClipBatches
from stmc.training.data.dataset import Dataset
from stmc.training.data.pair_batches import PairBatches
from stmc.training.tmr_objective import divergence, info_nce, kl_terms

SIZES = {"width": 16, "feedforward": 32, "layers": 1, "heads": 2}


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def small(features: int = 6, text_width: int = 5, **settings) -> Tmr:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Tmr(features, text_width, **(SIZES | settings))


def evaluator() -> Evaluator:
    config = {
        "network": {"_target_": "stmc.evaluators.Tmr", "features": 205, "text_width": 384, **SIZES},
        "text_encoder": {"_target_": "stmc.text.MiniLM", "pooling": "tokens"},
        "representation": {"_target_": "stmc.motion.representation.SmplRepresentation"},
    }
    statistics = [Statistics(drawn(width), 1 + drawn(width, seed=1).abs()) for width in (205, 384)]
    network = small(205, 384).eval().requires_grad_(False)
    return Evaluator(network, Hashes(), SmplRepresentation(), *statistics, 20, config)


def test_a_latent_does_not_depend_on_the_padding_nor_on_the_batch():
    network = small().eval()
    rows = [drawn(length, 6, seed=length) for length in (5, 9, 1)]
    batch, lengths = pad(rows)
    together = network.motion_encoder(batch + 100 * ~mask(lengths)[..., None], mask(lengths))
    for row, mean, log_variance in zip(rows, *together, strict=True):
        alone = network.motion_encoder(row[None])
        torch.testing.assert_close(alone.mean[0], mean, atol=1e-5, rtol=0)
        torch.testing.assert_close(alone.log_variance[0], log_variance, atol=1e-5, rtol=0)
    decoded = network.motion_decoder(together.mean, mask(lengths))
    assert decoded.shape == batch.shape and (decoded[~mask(lengths)] == 0).all()
    alone = network.motion_decoder(together.mean[2:], mask(lengths[2:]))
    torch.testing.assert_close(alone[0], decoded[2, :1], atol=1e-5, rtol=0)


def test_a_sequence_longer_than_all_positions_is_an_error():
    with pytest.raises(ValueError, match="5001 tokens exceed the 5000"):
        small().motion_encoder(torch.zeros(1, 4999, 6))


def test_points_are_drawn_around_the_mean_with_the_posteriors_variance():
    posterior = Posterior(torch.full((20_000, 2), 3.0), torch.full((20_000, 2), math.log(4.0)))
    points = posterior.rsample(torch.Generator().manual_seed(0))
    assert points.mean() == pytest.approx(3.0, abs=0.05) and points.std() == pytest.approx(2.0, abs=0.05)
    assert torch.equal(Posterior(points, None).rsample(), points)


def test_the_divergence_of_two_normals_is_that_of_the_closed_form():
    first = Posterior(torch.tensor([[1.0, 0.0]]), torch.tensor([[math.log(4.0), 0.0]]))
    second = Posterior(torch.tensor([[0.0, 0.0]]), torch.tensor([[0.0, 0.0]]))
    expected = (math.log(1 / 2) + (4 + 1) / 2 - 1 / 2) / 2  # of N(1, 4) from N(0, 1), and of N(0, 1) from itself
    assert float(divergence(first, second)) == pytest.approx(expected)
    assert float(divergence(first, first)) == pytest.approx(0)
    assert kl_terms(first, Posterior(first.mean, None)).tolist() == [0.0] * 4


def test_pairs_that_are_all_right_or_all_alike_have_the_contrast_of_the_closed_form():
    right = torch.eye(4)
    assert float(info_nce(right, right, temperature=0.5)) == pytest.approx(math.log(1 + 3 * math.exp(-2)))
    assert float(info_nce(torch.ones(4, 2), torch.ones(4, 2))) == pytest.approx(math.log(4))
    assert float(info_nce(torch.ones(4, 2), torch.ones(4, 2), torch.ones(4, 4, dtype=torch.bool))) == pytest.approx(0)
    alike = torch.zeros(4, 4, dtype=torch.bool)
    alike[0, 1:] = True  # text 0 has no wrong motion; each motion but 0 has one wrong text less
    expected = (3 * math.log(4) / 4 + (math.log(4) + 3 * math.log(3)) / 4) / 2
    assert float(info_nce(torch.ones(4, 2), torch.ones(4, 2), alike)) == pytest.approx(expected)


def test_the_objective_is_one_of_the_loops_and_reaches_every_weight():
    objective, network = TmrObjective(), small()
    assert isinstance(objective, Objective)
    pairs = Pairs(drawn(3, 7, 6), None, drawn(3, 4, 5), None, 21)
    terms = objective(network, pairs, torch.Generator().manual_seed(0))
    objective.weigh(terms).backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in network.parameters())
    losses = objective.losses(terms.detach() / 21)
    assert tuple(losses) == objective.names
    parts = [losses[f"loss_{name}"] for name in ("reconstruction", "kl", "latent", "contrastive")]
    assert losses["loss"] == pytest.approx(parts[0] + 1e-5 * parts[1] + 1e-5 * parts[2] + 0.1 * parts[3], rel=1e-5)


@torch.no_grad()
def test_every_so_many_rows_are_rebuilt_as_all_would_be():
    network, given = small().eval(), (drawn(5, 4, 5), None, drawn(5, 7, 6), None)
    whole, some = (network(*given, torch.Generator().manual_seed(0), every) for every in (1, 2))
    for all_rows, rows in zip(whole.rebuilt, some.rebuilt, strict=True):
        assert len(rows) == 3
        torch.testing.assert_close(rows, all_rows[::2], atol=1e-5, rtol=0)
    pairs = Pairs(given[2], None, given[0], None, 1)
    expected = sum(smooth_l1_loss(rows, pairs.motion[::2]) for rows in some.rebuilt)
    terms = TmrObjective(rebuild_every=2)(network, pairs, torch.Generator().manual_seed(0))
    assert float(terms[0]) == pytest.approx(float(expected), rel=1e-4)
    with pytest.raises(ValueError, match="rebuild_every must be at least 1, not 0"):
        TmrObjective(rebuild_every=0)


@torch.no_grad()
def test_an_evaluator_restated_for_other_statistics_hears_and_says_the_same_motion():
    network, raw = small().eval(), drawn(2, 7, 6)
    old = Statistics(drawn(6, seed=1), drawn(6, seed=2).abs() + 0.5)
    new = Statistics(drawn(6, seed=3), 1.2 * old.std)
    latent = network.motion_encoder(old.normalise(raw)).mean
    exists = torch.ones(2, 7, dtype=torch.bool)
    said = old.restore(network.motion_decoder(latent, exists))
    network.restate(old, new)
    torch.testing.assert_close(network.motion_encoder(new.normalise(raw)).mean, latent, atol=1e-5, rtol=0)
    torch.testing.assert_close(new.restore(network.motion_decoder(latent, exists)), said, atol=1e-5, rtol=0)


def test_texts_and_motions_become_latents_in_their_order_and_alone():
    judge = evaluator()
    rows = [drawn(length, 205, seed=length) for length in (30, 4, 90, 12)]
    latents = judge.motions(rows)
    assert latents.shape == (4, 16)
    for row, latent in zip(rows, latents, strict=True):
        torch.testing.assert_close(judge.motions([row])[0], latent, atol=1e-5, rtol=0)
    normal = judge.motion_statistics.normalise(rows[1])[None]
    torch.testing.assert_close(judge.network.motion_encoder(normal).mean[0], latents[1], atol=1e-5, rtol=0)
    texts = ["walk", "raise the left arm"]
    torch.testing.assert_close(judge.texts(texts[::-1]), judge.texts(texts).flip(0), atol=1e-5, rtol=0)
    for wrong in ([], [torch.zeros(0, 205)]):
        with pytest.raises(ValueError, match="nothing to encode"):
            judge.motions(wrong)


def test_a_motion_of_another_frame_rate_is_judged_at_the_evaluators():
    judge, motion = evaluator(), walking(3.0, 40.0)
    assert judge.features(motion).shape == (60, 205)
    torch.testing.assert_close(judge.features(motion), judge.features(motion.resampled(20)))


def test_an_evaluator_is_shown_in_one_short_line():
    shown = repr(stmc.load_evaluator(device="cpu"))
    assert "\n" not in shown and len(shown) < 120
    assert shown.startswith("Evaluator(") and "20 fps" in shown


def test_an_evaluator_survives_its_run_directory_wherever_that_is_moved(tmp_path):
    judge = evaluator()
    folder = save_evaluator(judge, tmp_path / "run", "# card").rename(tmp_path / "moved")
    back = load_evaluator(folder)
    rows = [drawn(20, 205)]
    assert torch.equal(back.motions(rows), judge.motions(rows))
    assert torch.equal(back.text_statistics.std, judge.text_statistics.std)
    assert back.fps == 20 and not back.network.training
    again = save_evaluator(back, tmp_path / "again", "# card")
    assert (again / WEIGHTS).read_bytes() == (folder / WEIGHTS).read_bytes()
    assert (again / CONFIG).read_text() == (folder / CONFIG).read_text()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace("layers: 1", "layers: 2"), "does not fit the network of the config"),
        (
            lambda text: text.replace("stmc.evaluators.Tmr", "os.system"),
            "'os.system' is not a class of stmc.evaluators",
        ),
        (lambda text: text.replace("fps: 20", "fps: -1"), "fps=-1: must be above 0"),
        (lambda text: text.replace("network:", "net:"), "network missing"),
    ],
)
def test_a_damaged_run_directory_of_an_evaluator_is_an_error(tmp_path, damage, message):
    folder = save_evaluator(evaluator(), tmp_path / "run", "# card")
    (folder / CONFIG).write_text(damage((folder / CONFIG).read_text()))
    with pytest.raises(RunError, match=message):
        load_evaluator(folder)


def test_the_guo_evaluator_gives_embeddings_in_the_order_of_its_inputs_and_refuses_what_is_too_short():
    network = GuoEvaluator(7, (8, 8), 8, 6, 8, 5).eval()
    motions, lengths = drawn(3, 20, 9), torch.tensor([8, 20, 12])
    together = network.motions(motions, lengths)
    for index, length in enumerate(lengths.tolist()):
        alone = network.motions(motions[index : index + 1], lengths[index : index + 1])
        torch.testing.assert_close(alone[0], together[index], atol=1e-5, rtol=0)
        unseen = motions[index : index + 1].clone()
        unseen[..., -2:] += 1  # contacts
        unseen[:, length + 3 :] += 1
        torch.testing.assert_close(network.motions(unseen, lengths[index : index + 1])[0], alone[0])
    with pytest.raises(ValueError, match="3 frames is too short"):
        network.motions(motions, torch.tensor([8, 3, 12]))


def pair_batches(composed: float = 0.0, **settings) -> PairBatches:
    dataset = Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3)
    recipe = BalancedBatches(rows=24, pool=2, pieces=1, uncond_crop_prob=0.0, text_dropout=0.0, compose_prob=composed)
    return PairBatches(ClipBatches(dataset, "train", recipe), **settings)


def test_every_row_has_a_text_and_texts_of_one_clip_are_no_wrong_answers_to_each_other():
    batches = pair_batches()
    dataset = batches.batches.dataset
    [pairs], [plan] = batches(3), batches.batches.plans(3)
    assert (plan.sentence != 0).all() and pairs.alike.shape == (len(plan.sentence),) * 2
    says = [dataset.sentences[sentence] for sentence in plan.sentence]
    shows = [dataset.clips[clip].content for clip in plan.body.clip]
    truth = {"walk": "walk", "a walk": "walk", "raise the arm": "raise"}
    assert pairs.alike.tolist() == [[truth[text] == content for content in shows] for text in says]
    assert len(set(says)) > 1 and set(shows) == {"walk", "raise"}
    torch.testing.assert_close(pairs.motion, batches.batches(3)[0].motion)


def test_texts_that_an_encoder_finds_similar_are_no_wrong_answers_either():
    [loose] = pair_batches(sentences=LetterCounts(), threshold=-0.1)(0)
    assert loose.alike.all()
    [strict] = pair_batches(sentences=LetterCounts(), threshold=1.1)(0)
    assert torch.equal(strict.alike, pair_batches()(0)[0].alike)


def composing() -> PairBatches:
    """Walks, and raises of the left arm that are put on walks."""
    table = cache()
    raising = [
        Clip(**(vars(clip) | {"parts": ("left arm",)})) if clip.content == "raise" else clip for clip in table.clips
    ]
    dataset = Dataset(
        Cache(table.fps, "toy", table.features, tuple(raising), table.texts), LetterCounts(), LAYOUT, min_clips=3
    )
    recipe = BalancedBatches(
        rows=32, pool=2, pieces=1, uncond_crop_prob=0.0, text_dropout=0.0, compose_prob=1.0, shortest=4.0
    )
    return PairBatches(ClipBatches(dataset, "train", recipe))


def test_a_composition_shows_what_both_of_its_clips_show():
    batches = composing()
    [plan] = batches.batches.plans(0)
    composed = plan.donor.frames > 0
    assert composed.any() and not composed.all()
    alike = batches.match_texts(plan)
    assert alike[:, torch.from_numpy(composed)].all()  # walks and raises: true of both texts
    assert not alike[:, torch.from_numpy(~composed)].all()


def test_what_a_cut_has_lost_is_no_answer():
    batches = composing()
    [plan] = batches.batches.plans(0)
    cut = dataclasses.replace(plan, other=plan.sentence)
    composed = torch.from_numpy(plan.donor.frames > 0)
    says = [batches.batches.dataset.sentences[sentence] for sentence in plan.sentence]
    walks = torch.tensor(["walk" in text for text in says])
    assert walks.any() and not batches.match_texts(cut)[walks][:, composed].any()
    assert batches.match_texts(cut)[~walks][:, composed].all()


def test_half_of_the_compositions_have_the_text_of_the_other_clip(monkeypatch):
    batches, told = composing(), []
    batch = batches.batches.dataset.batch
    monkeypatch.setattr(batches.batches.dataset, "batch", lambda plan: told.append(plan) or batch(plan))
    for step in range(12):
        batches(step)
    asked = [plan for step in range(12) for plan in batches.batches.plans(step)]
    rows = [
        (own, was, other)
        for new, old in zip(told, asked, strict=True)
        for own, was, other in zip(new.sentence, old.sentence, old.other, strict=True)
        if was != other
    ]
    assert len(rows) > 50
    assert all(own in (was, other) for own, was, other in rows)
    assert 0.3 < sum(own == other for own, _, other in rows) / len(rows) < 0.7


def test_rows_without_texts_make_no_pairs():
    dataset = Dataset(cache(), LetterCounts(), LAYOUT, min_clips=3)
    with pytest.raises(ValueError, match=r"text_dropout \(0.1\) must be 0"):
        PairBatches(ClipBatches(dataset, "train", BalancedBatches()))
    with pytest.raises(ValueError, match=r"uncond_crop_prob \(0.12\) must be 0"):
        PairBatches(ClipBatches(dataset, "train", BalancedBatches(text_dropout=0.0)))
    with pytest.raises(ValueError, match=r"joined_prob \(0.2\) must be 0"):
        PairBatches(
            ClipBatches(dataset, "train", BalancedBatches(uncond_crop_prob=0.0, text_dropout=0.0, joined_prob=0.2))
        )


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A few steps on 24 clips that walk slowly or run."""
    folder = tmp_path_factory.mktemp("tmr")
    clips, rows, start = [], [], 0
    for number in range(24):
        content = ("walk", "run")[number % 2]
        features = SmplRepresentation().encode(walking(2.0 + 0.1 * number, 20.0, (0.8, 3.0)[number % 2])).float()
        split = ("train", "train", "train", "train", "val", "test")[number // 2 % 6]
        end = start + len(features)
        clips.append(Clip(f"{content}-{number}", content, "", content, ("legs",), True, False, split, start, end))
        rows.append(features)
        start = end
    texts = {"walk": (("walk forwards", 0.5), ("a person walks", 0.5)), "run": (("run", 1.0),)}
    Cache(20, "smpl", torch.cat(rows), tuple(clips), texts).write(folder / "cache")
    settings = [f"run={folder / 'run'}", f"data.folder={folder / 'cache'}", f"text_cache={folder / 'texts'}"]
    settings += [f"network.{name}={size}" for name, size in SIZES.items()]
    settings += [
        "device=cpu",
        "threads=1",
        "validation=1",
        "data.sampling.rows=8",
        "+text_encoder@false_negative_encoder=minilm",
    ]
    settings += [
        "training.log_every=2",
        "training.warmup=1",
        "training.validate_every=2",
        "training.checkpoint_every=4",
    ]
    done = script("train_tmr", *settings, "training.steps=4", folder=folder / "here")
    return folder, settings, done


@pytest.mark.slow
def test_training_leaves_an_evaluator_and_says_what_it_finds(trained):
    folder, _, done = trained
    judge = load_evaluator(folder / "run")
    features = [judge.features(walking(3.0, 20.0, speed)) for speed in (0.8, 3.0)]
    assert judge.motions(features).isfinite().all()
    results = json.loads((folder / "run" / "results.json").read_text())
    assert results["step"] == 4
    assert results["test"]["all"]["t2m"]["candidates"] == 4
    assert results["test"]["true"]["m2t"]["recall"]["1"] in (0, 25, 50, 75, 100)
    with (folder / "run" / "retrieval.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["2", "4"]
    with (folder / "run" / "train.csv").open() as file:
        [_, last] = csv.DictReader(file)
    assert float(last["loss_contrastive"]) > 0
    assert "resuming" not in done.stdout


@pytest.mark.slow
def test_training_goes_on_where_it_stopped(trained):
    folder, settings, _ = trained
    longer = ("training.steps=6", "training.lr_decay_steps=4")
    done = script("train_tmr", *settings, *longer, folder=folder / "here")
    assert "4 of 6 steps done" in done.stdout
    assert json.loads((folder / "run" / "results.json").read_text())["step"] == 6
    with (folder / "run" / "retrieval.csv").open() as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["2", "4", "6"]


@pytest.mark.slow
def test_training_begins_with_the_weights_it_is_given(trained):
    folder, settings, _ = trained
    begun = [f"run={folder / 'begun'}", f"init_from={folder / 'run'}", "training.lr=1e-12", "training.steps=4"]
    script("train_tmr", *settings[1:], *begun, folder=folder / "here")
    rows = [drawn(30, 205)]
    first, second = (load_evaluator(folder / name) for name in ("run", "begun"))
    torch.testing.assert_close(second.motions(rows), first.motions(rows), atol=1e-3, rtol=0)
    torch.testing.assert_close(second.texts(["run"]), first.texts(["run"]), atol=1e-3, rtol=0)


def test_cosines_of_latents_are_what_training_compares():
    text, motion = drawn(3, 16), drawn(3, 16, seed=1)
    logits = normalize(text, dim=-1) @ normalize(motion, dim=-1).T / 0.1
    expected = (-logits.log_softmax(1).diag().mean() - logits.log_softmax(0).diag().mean()) / 2
    assert float(info_nce(text, motion)) == pytest.approx(float(expected), rel=1e-5)
