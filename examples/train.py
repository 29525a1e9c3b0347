"""Train a small network on an event set: from noisy counts to activity.

    mphdrr events new --like mixed -o mixed.toml
    mphdrr events make mixed --recipe mixed.toml -n 1000 --workers 2
    python train.py mixed --epochs 20 --loaders 2

Without a set it makes a tiny one in a temporary folder, to see that all works. The network gets the counts back-projected
into the volume, and learns what is missing between that and the truth. It is a beginning, not a good reconstruction. Needs
torch: pip install "mphdrr[torch]".
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import torch
from torch.utils.data import DataLoader

import mphdrr.core as mph
from mphdrr.core.events import EventSet

WORKBOOK = Path(__file__).with_name("dc-spect-80.xlsx")
TINY = f"""
version = 1
seed = 1
system = {{ file = '{WORKBOOK}' }}
detector = {{ plane = "real", rows = 12, columns = 12 }}
truth = {{ voxels = 16, spacing = 8.0 }}
models.emission = {{ kind = "emission", isotope = "Tc-99m", time = 600 }}
noise = {{ levels = [1.0, 0.5] }}
splits = {{ train = 0.75, validation = 0.25 }}

[[phantoms]]
kind = "derenzo"
radius = {{ from = 30, to = 45 }}
rod_diameters = [16, 14, 12, 10, 0, 0]
activity = {{ from = 50, to = 150 }}
pose = {{ turn = "uniform" }}
"""


def main() -> None:
    """Train on the given event set, or on a tiny one made for this purpose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", nargs="?", help="folder of an event set with splits train and validation")
    parser.add_argument("--model", default="emission", help="of the recipe, whose counts are the network's input")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--loaders", type=int, default=0, help="processes that read events")
    parser.add_argument("-o", "--output", help="file for the network's weights (.pt)")
    arguments = parser.parse_args()
    if arguments.set is not None:
        train(EventSet(arguments.set), arguments)
        return
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder, "tiny.toml")
        recipe.write_text(TINY, encoding="utf-8")
        train(mph.events.make(mph.events.read_recipe(recipe), Path(folder, "set"), 8), arguments)


def train(events: EventSet, arguments: argparse.Namespace) -> None:
    """Train the network, and print the loss of training and validation after each epoch."""
    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    fields = (arguments.model, "truth")
    # Training: other noise in each epoch. Validation: always the same.
    data = mph.events.torch_dataset(events.split("train"), fields, noise="epoch")
    test = mph.events.torch_dataset(events.split("validation"), fields, noise="own", levels=1.0)
    loading = {"batch_size": arguments.batch, "num_workers": arguments.loaders}
    loader, test_loader = DataLoader(data, shuffle=True, **loading), DataLoader(test, **loading)

    # Back to the volume: the exact adjoint of a simple model of the scanner, by its sensitivity.
    first = events[0]
    simple = mph.Emission(first.system, hole="point", pixel_points=1, tolerance=1e9)
    A = mph.Projector(first.truth.grid, first.views, simple)
    sensitivity = A.T(torch.ones((len(first.views), *first.views.shape)))
    sensitivity = sensitivity.clamp(min=0.01 * float(sensitivity.max()))
    scale = float(first.truth.array.max())

    def prepared(batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return input and target (B, 1, n_x, n_y, n_z), both about 1."""
        back = A.T(batch[arguments.model]) / sensitivity
        back = back / back.amax(dim=(1, 2, 3), keepdim=True).clamp(min=1e-12)
        return back[:, None].to(device), batch["truth"][:, None].to(device) / scale

    network = small_network().to(device)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for epoch in range(arguments.epochs):
        began, sums = time.perf_counter(), {"train": 0.0, "validation": 0.0}
        data.set_epoch(epoch)
        for name, batches in (("train", loader), ("validation", test_loader)):
            with torch.set_grad_enabled(name == "train"):
                for batch in batches:
                    source, target = prepared(batch)
                    loss = torch.nn.functional.mse_loss(network(source), target)
                    if name == "train":
                        optimizer.zero_grad()
                        loss.backward()
                        optimizer.step()
                    sums[name] += float(loss.detach()) * len(target)
        means = {"train": sums["train"] / len(data), "validation": sums["validation"] / max(len(test), 1)}
        said = ", ".join(f"{name} {value:.5f}" for name, value in means.items())
        print(f"epoch {epoch + 1} of {arguments.epochs}: {said}, {time.perf_counter() - began:.1f} s")
    if arguments.output:
        torch.save(network.state_dict(), arguments.output)
        print(arguments.output)


def small_network(channels: int = 16) -> torch.nn.Module:
    """Return a network of four convolutions."""
    layers: list[torch.nn.Module] = [torch.nn.Conv3d(1, channels, 3, padding=1), torch.nn.ReLU()]
    for _ in range(2):
        layers += [torch.nn.Conv3d(channels, channels, 3, padding=1), torch.nn.ReLU()]
    return torch.nn.Sequential(*layers, torch.nn.Conv3d(channels, 1, 3, padding=1))


if __name__ == "__main__":
    main()
