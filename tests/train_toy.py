"""Trains a toy in a process of its own, for tests that kill or multiply processes."""

import argparse
import csv
from pathlib import Path

import torch
from test_training import trainer


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    run = trainer(arguments.folder, steps=arguments.steps)
    draw, update, drawn, measured = run.batches, run._update, [], []

    def drawing(step: int, process: int) -> list:
        pieces = draw(step, process)
        drawn.append(sum(piece.frames for piece in pieces))
        return pieces

    def updating() -> torch.Tensor:
        measured.append(update())
        return measured[-1]

    run.batches, run._update = drawing, updating
    run.run()
    rank = run.accelerator.process_index
    torch.save({"network": run.network.state_dict(), "drawn": drawn}, arguments.folder / f"process-{rank}.pt")
    if run.accelerator.is_main_process:
        with (arguments.folder / "frames.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frames"])
            writer.writerows([row[-2].item()] for row in measured)


if __name__ == "__main__":
    main()
