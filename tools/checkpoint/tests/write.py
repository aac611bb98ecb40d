"""Writes the checkpoints in tests/data, each in a form that PyTorch has written: python write.py

PyTorch 2.15 wrote those that are kept. A network here is a tree of modules with the names and shapes of a `.keys` file: what
is saved is its state dict, as training scripts save one.
"""

import io
import math
import pathlib
import zipfile

import torch

DATA = pathlib.Path(__file__).parent / "data"


def network(name: str) -> torch.nn.Module:
    """The modules that a list of keys names, with numbers that keep the size of what passes through them."""
    torch.manual_seed(1)
    root = torch.nn.Module()
    for line in (DATA / f"{name}.keys").read_text().splitlines():
        key, shape = line.split(" ", 1)
        *modules, leaf = key.split(".")
        parent = root
        for module in modules:
            if module not in parent._modules:
                parent.add_module(module, torch.nn.Module())
            parent = parent._modules[module]
        numbers = torch.rand(eval(shape)) * 2 - 1
        if leaf == "running_mean":
            parent.register_buffer(leaf, 0.1 * numbers)
        elif leaf == "running_var":
            parent.register_buffer(leaf, 1 + 0.5 * numbers)
            parent.register_buffer("num_batches_tracked", torch.tensor(7))
        elif numbers.dim() == 1:
            is_factor = leaf == "weight"
            parent.register_parameter(leaf, torch.nn.Parameter(1 + 0.5 * numbers if is_factor else 0.1 * numbers))
        else:
            width = math.sqrt(6 / numbers[0].numel())
            parent.register_parameter(leaf, torch.nn.Parameter(width * numbers))
    return root


def save(name: str, what, **how):
    torch.save(what, DATA / f"{name}.pth", **how)


def trained(model: torch.nn.Module):
    """An optimizer and a schedule that have made a step."""
    optimizer = torch.optim.Adam(model.parameters())
    schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, [10, 20])
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    sum(parameter.sum() for parameter in model.parameters()).backward()
    optimizer.step()
    schedule.step()
    model.load_state_dict(before)
    return optimizer.state_dict(), schedule.state_dict()


def flat(state: dict) -> dict:
    """The same tensors as pieces of one storage, matrices as the transposed of what is saved."""
    floats = {key: tensor.t().contiguous() if tensor.dim() == 2 else tensor for key, tensor in state.items()}
    floats = {key: tensor for key, tensor in floats.items() if tensor.is_floating_point()}
    storage = torch.cat([tensor.flatten() for tensor in floats.values()])
    pieces, at = {}, 0
    for key, tensor in floats.items():
        piece = storage[at : at + tensor.numel()].view(tensor.shape)
        pieces[key] = piece.t() if tensor.dim() == 2 else piece
        at += tensor.numel()
    assert all(torch.equal(pieces[key], state[key]) for key in pieces)
    return pieces


def big_endian(file: pathlib.Path, out: pathlib.Path):
    """What a machine with the highest byte first would have written; PyTorch reads it."""
    with zipfile.ZipFile(file) as little, zipfile.ZipFile(out, "w") as big:
        for entry in little.infolist():
            numbers = little.read(entry)
            folder, _, name = entry.filename.partition("/")
            if name == "byteorder":
                numbers = b"big"
            elif name.startswith("data/"):
                # The counters of batches are the only storages of one number of eight bytes.
                width = 8 if len(numbers) == 8 else 4
                numbers = b"".join(numbers[i : i + width][::-1] for i in range(0, len(numbers), width))
            big.writestr(f"{folder}/{name}", numbers)
    ours, theirs = torch.load(file), torch.load(out)
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)


class Command:
    def __reduce__(self):
        import os

        return os.system, ("echo a checkpoint ran this > ran",)


def main():
    model = network("small-attfuse")
    state = model.state_dict()
    optimizer, schedule = trained(model)
    save("plain", state)
    save("parallel", torch.nn.DataParallel(model).state_dict())
    save("parameters", dict(model.named_parameters()) | dict(model.named_buffers()))
    save("nested", {"epoch": 30, "model_state_dict": state, "optimizer": optimizer, "schedule": schedule})
    save("legacy", {"state_dict": flat(state), "epoch": 31, "optimizer": optimizer}, _use_new_zipfile_serialization=False)
    save("views", flat(state))
    for name, dtype in [("half", torch.float16), ("bfloat16", torch.bfloat16), ("double", torch.float64)]:
        cast = {key: tensor.to(dtype) if tensor.is_floating_point() else tensor for key, tensor in state.items()}
        save(name, cast)
    save("whole", state | {"cls_head.weight": torch.ones(state["cls_head.weight"].shape, dtype=torch.int32)})
    save("nan", state | {"cls_head.bias": torch.full_like(state["cls_head.bias"], math.nan)})
    save("repeated", state | {"cls_head.bias": torch.zeros(1).expand_as(state["cls_head.bias"])})
    save("command", state | {"extra": Command()})
    save("whole_model", {"state_dict": torch.nn.Linear(2, 2)})
    save("empty", {"state_dict": {}, "epoch": 1})
    save("protocol4", state, pickle_protocol=4)
    big_endian(DATA / "plain.pth", DATA / "big_endian.pth")
    save("v2xvit", network("small-v2xvit").state_dict())


main()
