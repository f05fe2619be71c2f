#!/usr/bin/env python3
"""The network of sigma-srn in plain PyTorch, float32 and eager: the peer that `cargo xtask bench` compares times with.

    python3 bench/peer.py check FILE.safetensors...    against golden values; exit 1 beyond a relative difference of 1e-4
    python3 bench/peer.py chance FILE.safetensors...   how often PyTorch itself parts from golden values, for no more than rounding
    echo "pose step, kept" | python3 bench/peer.py serve --width 64    the seconds of each step that a line names

It serves no other purpose. Both steps come in two versions: "as released" evaluates the scene features f again at every point
for the density-weighted sum, as the authors' code does; "kept" reuses those of the march. `check` runs the very steps that
`serve` measures. Tensors have the names of the golden files, so that weights map one to one.
"""

import argparse
import json
import math
import platform
import statistics
import sys
import time
from pathlib import Path
from typing import NamedTuple


def refuse(message):
    print("error:", " ".join(str(message).split()), file=sys.stderr)
    sys.exit(2)


try:
    import torch
    from torch import nn
    from torch.nn import functional as F
except ImportError as error:
    refuse(f"PyTorch (the Python package torch) cannot be imported: {error}")

SIDE, HYPOTHESES, INSTANCES, TRACING_STEPS = 64, 5, 9, 10
LATENT = {64: 32, 256: 256}
VERSIONS = {"as released": False, "kept": True}
TOLERANCE = 1e-4
# What `chance` looks at, and the limits of `cargo xtask golden` for it.
MOVED = [("trained parameters", 5e-4), ("refined poses", 2e-3)]


class Net(nn.Module):
    """Layers one after another, named `net.0`, `net.1`, …"""

    def __init__(self, *layers):
        super().__init__()
        self.net = nn.Sequential(*layers)

    def forward(self, x):
        return self.net(x)


def mlp(*sizes):
    """Linear, layer normalisation and ReLU from size to size; the last layer is linear alone."""
    hidden = [Net(nn.Linear(i, o), nn.LayerNorm(o), nn.ReLU(inplace=True)) for i, o in zip(sizes, sizes[1:-1])]
    return Net(*hidden, nn.Linear(*sizes[-2:]))


class Batch(NamedTuple):
    """What a step is given, B images of R rays."""

    instances: torch.Tensor  # [B]
    lifted: torch.Tensor  # [B, R, 3], pixels at z = 1 of the camera
    z0: torch.Tensor  # [B, R, 1], initial depths
    target: torch.Tensor  # [B, R, 3], colours


class Model(nn.Module):
    def __init__(self, hidden, latent, instances, tracing_steps, density=True):
        super().__init__()
        self.tracing_steps = tracing_steps
        self.shapes = [(3, hidden)] + 3 * [(hidden, hidden)]
        self.latent_codes = nn.Embedding(instances, latent)
        hyper = [mlp(latent, latent, latent, i * o + o) for i, o in self.shapes]
        layers = [nn.ModuleDict({"hyper_linear": nn.ModuleDict({"hypo_params": net})}) for net in hyper]
        self.hyper_phi = nn.ModuleDict({"layers": nn.ModuleList(layers)})
        self.ray_marcher = nn.ModuleDict({"lstm": nn.LSTMCell(hidden, 16), "out_layer": nn.Linear(16, 1)})
        self.sigma = mlp(3, hidden, hidden, hidden, 1) if density else None
        self.pixel_generator = mlp(*6 * [hidden], 3)

    def scene(self, codes):
        """Weights [B, in, out] and biases [B, 1, out] of the layers of f, out of the hypernetwork."""
        weights = []
        for (i, o), layer in zip(self.shapes, self.hyper_phi.layers):
            weight, bias = layer.hyper_linear.hypo_params(codes).split([i * o, o], dim=1)
            weights.append((weight.unflatten(1, (o, i)).transpose(1, 2), bias[:, None]))
        return weights

    def forward(self, scene, world_from_camera, batch, keep):
        """Colours [B, R, 3] and depths [B, R, 1]; `keep` reuses the features of the march in the sum."""
        rotation, centre = world_from_camera[..., :3], world_from_camera[..., 3].unsqueeze(1)
        along = batch.lifted @ rotation.mT
        direction = F.normalize(along, dim=-1)
        x, state = centre + batch.z0 * along, None
        points, kept = [x], []
        for _ in range(self.tracing_steps):
            kept.append(features(scene, x))
            state = self.ray_marcher.lstm(kept[-1].flatten(0, 1), state)
            if state[0].requires_grad:
                # A hook sees the sum over all uses of the state, which is what the training clamps.
                state[0].register_hook(lambda gradient: gradient.clamp(-10, 10))
            x = x + direction * self.ray_marcher.out_layer(state[0]).view_as(batch.z0)
            points.append(x)
        if self.sigma is None:
            phi = features(scene, x)
        else:
            again = kept + [features(scene, x)] if keep else (features(scene, point) for point in points)
            phi = x.new_zeros(1)
            for point, feature in zip(points, again):
                phi = torch.addcmul(phi, self.sigma(point), feature)
        return self.pixel_generator(phi), ((x - centre) @ rotation)[..., 2:]


def features(scene, x):
    """f at the points [B, R, 3], with weights of its own for each image."""
    for weight, bias in scene:
        x = F.relu(F.layer_norm(torch.baddbmm(bias, x, weight), weight.shape[2:]), inplace=True)
    return x


def pose_matrix(pose):
    """Six numbers [B, 6] to world_from_camera [B, 3, 4], R = Rx Ry Rz."""
    (s1, s2, s3), (c1, c2, c3) = pose[:, :3].sin().unbind(1), pose[:, :3].cos().unbind(1)
    t1, t2, t3 = pose[:, 3:].unbind(1)
    rows = [c2 * c3, -c2 * s3, s2, t1]
    rows += [c1 * s3 + c3 * s1 * s2, c1 * c3 - s1 * s2 * s3, -c2 * s1, t2]
    rows += [s1 * s3 - c1 * c3 * s2, c3 * s1 + c1 * s2 * s3, c1 * c2, t3]
    return torch.stack(rows, dim=1).unflatten(1, (3, 4))


def lift(uv, fx, fy, cx, cy):
    u, v = uv.unbind(-1)
    return torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u)], dim=-1)


def pose_step(model, scene, poses, adam, batch, keep):
    """One step of Adam on the six numbers of every hypothesis; returns the losses before it."""
    adam.zero_grad()
    rgb, _ = model(scene, pose_matrix(poses), batch, keep)
    losses = (rgb - batch.target).abs().mean(dim=(1, 2))
    losses.sum().backward()
    adam.step()
    return losses.detach()


def training_step(model, world_from_camera, adam, batch, keep):
    """One step of Adam on every parameter; returns the total loss before it."""
    adam.zero_grad()
    codes = model.latent_codes(batch.instances)
    rgb, depth = model(model.scene(codes), world_from_camera, batch, keep)
    loss = 200 * F.mse_loss(rgb, batch.target) + codes.square().mean() + 10 * depth.clamp(max=0).square().mean()
    loss.backward()
    adam.step()
    return loss.detach()


def frozen(model, batch, pose, learning_rate=0.01):
    """The first arguments of `pose_step`: the network takes no gradient, and its hypernetwork runs once."""
    model.requires_grad_(False)
    poses = pose.clone().requires_grad_()
    return model, model.scene(model.latent_codes(batch.instances)), poses, torch.optim.Adam([poses], learning_rate)


def read_safetensors(path):
    """Tensors and metadata of a file."""
    data = Path(path).read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8:start]), bytearray(data[start:])
    metadata, tensors = header.pop("__metadata__", {}), {}
    for name, entry in header.items():
        dtype = {"F32": torch.float32, "I32": torch.int32}[entry["dtype"]]
        shape, (begin, _) = entry["shape"], entry["data_offsets"]
        tensors[name] = torch.frombuffer(body, dtype=dtype, count=math.prod(shape), offset=begin).view(shape)
    return tensors, metadata


def golden(tensors, metadata):
    """Model and batch of a golden file, and its cameras."""
    # The matrices of the file, in.cam2world, were rounded after the golden values were computed.
    intrinsics, cameras = tensors["in.intrinsics"].unsqueeze(3), pose_matrix(tensors["in.pose6"])
    lifted = lift(tensors["in.uv"], intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 0, 2], intrinsics[:, 1, 2])
    batch = Batch(tensors["in.instance_idx"].long(), lifted, tensors["in.initial_depth"], tensors["in.target_rgb"])
    sizes = [int(metadata[name]) for name in ["hidden", "latent", "instances", "tracing_steps"]]
    model = Model(*sizes, density=metadata["density"] == "True").to(lifted)
    model.load_state_dict({name.removeprefix("model."): tensors[name] for name in tensors if name.startswith("model.")})
    return model, batch, cameras


def golden_differences(tensors, metadata, keep):
    """The worst difference of each quantity, relative to the largest expected value of its tensor."""
    model, batch, cameras = golden(tensors, metadata)
    worst = {}

    def compare(quantity, actual, expected):
        difference = (actual - expected).abs().max() / expected.abs().max().clamp(min=1e-30)
        # Unlike Python's max, this lets a NaN through, which then fails.
        worst[quantity] = torch.maximum(worst.get(quantity, difference), difference)

    arguments = frozen(model, batch, tensors["in.pose6"])
    rgb, depth = model(arguments[1], cameras, batch, keep)
    compare("rgb", rgb, tensors["out.rgb"])
    compare("depth", depth, tensors["out.depth"])
    compare("pose loss", pose_step(*arguments, batch, keep), tensors["pose.mae.loss"])
    compare("pose gradient", arguments[2].grad, tensors["pose.mae.grad"])
    arguments = frozen(model, batch, tensors["refine.lr0.01.start"])
    # Two steps, here and below: after more, kinks lead two float32 programs apart.
    for losses, poses in zip(tensors["refine.lr0.01.losses"][:2], tensors["refine.lr0.01.poses"]):
        compare("refinement losses", pose_step(*arguments, batch, keep), losses)
        compare("refinement poses", arguments[2].detach(), poses)

    adam = torch.optim.Adam(model.requires_grad_(True).parameters(), 5e-5)
    for step, loss in enumerate(tensors["train.losses"][:2]):
        compare("training losses", training_step(model, cameras, adam, batch, keep), loss)
        for name, parameter in model.named_parameters() if step == 0 else []:
            compare("parameter gradients", parameter.grad, tensors["grad." + name])
    return {quantity: difference.item() for quantity, difference in worst.items()}


def check(files, device):
    passed = True
    for path in files:
        try:
            tensors, metadata = read_safetensors(path)
            tensors = {name: tensor.to(device) for name, tensor in tensors.items()}
            rows = {version: golden_differences(tensors, metadata, keep) for version, keep in VERSIONS.items()}
        except (OSError, AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            refuse(f"{path} cannot be checked: {type(error).__name__}: {error}")
        for version, row in rows.items():
            figures = [f"{name} {value:.1e}{'' if value <= TOLERANCE else ' FAILED'}" for name, value in row.items()]
            print(f"{path}, {version}: {', '.join(figures)}")
            passed &= all(value <= TOLERANCE for value in row.values())
    return 0 if passed else 1


def moved(tensors, metadata, seed):
    """How far trained parameters and refined poses end from their golden values when each weight begins up to 2^-24 of itself beside
    its own, as rounding to float32 may put it; relative to the largest value of the tensor, and the worst of each."""
    random = torch.Generator().manual_seed(seed)

    def begin():
        model, batch, cameras = golden(tensors, metadata)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter *= 1 + 2**-24 * (2 * torch.rand(parameter.shape, generator=random, dtype=torch.float64) - 1)
        return model, batch, cameras

    def difference(actual, expected):
        return ((actual.detach() - expected).abs().max() / expected.abs().max()).item()

    model, batch, cameras = begin()
    adam = torch.optim.Adam(model.parameters(), 5e-5)
    for _ in tensors["train.losses"]:
        training_step(model, cameras, adam, batch, keep=True)
    trained = [name for name in tensors if name.startswith("train.final.")]
    worst = [max(difference(model.get_parameter(name.removeprefix("train.final.")), tensors[name]) for name in trained)]
    refined = 0.0
    for rate in ["0.1", "0.01"]:
        model, batch, _ = begin()
        arguments, expected = frozen(model, batch, tensors[f"refine.lr{rate}.start"], float(rate)), tensors[f"refine.lr{rate}.poses"]
        for poses in expected:
            pose_step(*arguments, batch, keep=True)
            refined = max(refined, ((arguments[2].detach() - poses).abs().max() / expected.abs().max()).item())
    return [*worst, refined]


def chance(files, runs):
    for path in files:
        try:
            tensors, metadata = read_safetensors(path)
            for dtype in [torch.float32, torch.float64]:
                cast = {name: tensor.to(dtype) if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
                rows = [moved(cast, metadata, seed) for seed in range(runs)]
                for (quantity, limit), column in zip(MOVED, zip(*rows)):
                    beyond = sum(value > limit for value in column)
                    figures = f"median {statistics.median(column):.1e}, worst {max(column):.1e}, beyond {limit}: {beyond} of {runs}"
                    print(f"{path}, {dtype}, {quantity}: {figures}", flush=True)
        except (OSError, AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            refuse(f"{path} cannot be checked: {type(error).__name__}: {error}")
    return 0


def any_batch(images, device):
    """Rays and colours of the right sizes, seen from about where a camera would be; values do not matter for time."""
    grid = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE)).flip(1).float()
    lifted = lift(grid, 1.1625 * SIDE, 1.1625 * SIDE, SIDE / 2, SIDE / 2).repeat(images, 1, 1)
    z0 = torch.full((images, SIDE * SIDE, 1), 0.05)
    batch = Batch(torch.arange(images) % INSTANCES, lifted, z0, torch.rand_like(lifted) * 2 - 1)
    pose = torch.tensor([0, 0, 0, 0, 0, -1.3]) + 0.1 * torch.randn(images, 6)
    return Batch(*(tensor.to(device) for tensor in batch)), pose.to(device)


def steps(width, images, device):
    """The steps by their names; each returns the losses, which are yet to be read."""
    torch.manual_seed(0)
    looking, learning = (Model(width, LATENT[width], INSTANCES, TRACING_STEPS).to(device) for _ in range(2))
    batch, pose = any_batch(HYPOTHESES, device)
    batch = batch._replace(instances=torch.zeros_like(batch.instances))
    descent = (*frozen(looking, batch, pose), batch)
    batch, pose = any_batch(images, device)
    training = (learning, pose_matrix(pose), torch.optim.Adam(learning.parameters(), 5e-5), batch)
    poses = {f"pose step, {name}": lambda keep=keep: pose_step(*descent, keep) for name, keep in VERSIONS.items()}
    trainings = {f"training step, {name}": lambda keep=keep: training_step(*training, keep) for name, keep in VERSIONS.items()}
    return poses | trainings


def serve(arguments, device):
    """Says what it runs on and which steps there are, then takes the step that each line of its input names: seconds of one, of so many of
    which the last one's losses are read."""
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    named = steps(arguments.width, arguments.images, device)
    name = torch.cuda.get_device_name() if device.type == "cuda" else platform.processor() or platform.machine()
    about = {"torch": torch.__version__, "device": name, "threads": torch.get_num_threads(), "steps": list(named)}
    print(json.dumps(about), flush=True)
    for line in map(str.strip, sys.stdin):
        if line not in named:
            refuse(f"{line} is none of: {'; '.join(named)}")
        begin = time.perf_counter()
        for _ in range(arguments.unread):
            losses = named[line]()
        losses.tolist()
        if device.type == "cuda":
            torch.cuda.synchronize()
        print(round((time.perf_counter() - begin) / arguments.unread, 6), flush=True)
    return 0


def count(text):
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number above 0")
    return int(text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    checking = commands.add_parser("check", help="compare with golden files")
    checking.add_argument("files", nargs="+", metavar="FILE")
    by_chance = commands.add_parser("chance", help="train and refine from weights moved within their rounding")
    by_chance.add_argument("files", nargs="+", metavar="FILE")
    by_chance.add_argument("--runs", type=count, default=16, help="runs in each precision (default: 16)")
    serving = commands.add_parser("serve", help="take the steps that the input names, and time them")
    serving.add_argument("--width", type=int, choices=LATENT, required=True)
    serving.add_argument("--threads", type=count, help="threads on the CPU (default: PyTorch's choice)")
    serving.add_argument("--images", type=count, default=10, help="images of the training step (default: 10)")
    serving.add_argument("--unread", type=count, default=1, help="steps before the losses are read (default: 1)")
    for command in [checking, serving]:
        command.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    for each in [parser, checking, by_chance, serving]:
        each.error = refuse
    arguments = parser.parse_args()
    if arguments.command == "chance":
        return chance(arguments.files, arguments.runs)
    if arguments.device == "cuda" and not torch.cuda.is_available():
        refuse("--device cuda: this PyTorch finds no CUDA device")
    device = torch.device(arguments.device)
    return check(arguments.files, device) if arguments.command == "check" else serve(arguments, device)


if __name__ == "__main__":
    sys.exit(main())
