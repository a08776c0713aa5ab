"""Trains a denoiser: `python scripts/train.py run=FOLDER data.folder=CACHE`; devices: `accelerate launch`."""

from pathlib import Path

import hydra
import torch
from accelerate import Accelerator
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from stmc.data.cache import Cache
from stmc.data.dataset import ClipBatches
from stmc.training import Hook, Trainer, save_weights, write_whole


@hydra.main(config_path="../configs", config_name="train", version_base="1.3")
def main(config: DictConfig) -> None:
    if config.threads:
        torch.set_num_threads(config.threads)
    accelerator = Accelerator(cpu=config.device == "cpu")
    folder, settings = Path(config.run).expanduser(), instantiate(config.training)
    cache = Cache.read(Path(config.data.folder).expanduser())
    layout = instantiate(config.representation).layout
    corpus = instantiate(config.data.corpus, _partial_=True)(
        cache=cache, encoder=instantiate(config.text), layout=layout, device=accelerator.device
    )
    sampling = instantiate(config.data.sampling)
    held_out = ClipBatches(corpus, "val", sampling, settings.seed)
    torch.manual_seed(settings.seed)
    sizes = {"features": corpus.features_width, "text_width": corpus.text_width}
    trainer = Trainer(
        instantiate(config.denoiser, **sizes),
        instantiate(config.schedule),
        ClipBatches(corpus, "train", sampling, settings.seed),
        folder,
        settings,
        validation=[piece for step in range(config.validation) for piece in held_out(step)],
        fields=layout.slices,
        hooks=[Hook(settings.checkpoint_every, lambda step, model: export(folder, config, sizes, model, corpus))],
        accelerator=accelerator,
    )
    trainer.run()


def export(folder: Path, config: DictConfig, sizes: dict[str, int], model: torch.nn.Module, corpus) -> None:
    """The moving average, the statistics and the resolved configuration: what sampling needs."""
    save_weights(folder / "weights.safetensors", model.state_dict())
    statistics = {"motion": corpus.motion, "text": corpus.text}
    tensors = {f"{name}_{part}": getattr(of, part) for name, of in statistics.items() for part in ("mean", "std")}
    save_weights(folder / "statistics.safetensors", tensors)
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    resolved.denoiser.update(sizes)
    write_whole(folder / "config.yaml", lambda path: OmegaConf.save(resolved, path))


if __name__ == "__main__":
    main()
