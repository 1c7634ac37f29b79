"""Fitting a network to examples: epochs of descent, the best weights kept, resumable."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Bool, Float

from wlplan.errors import InputError
from wlplan.io.files import write_bytes_atomic
from wlplan.training.settings import Settings
from wlplan.types import PyTree

# Part of the steps over which the learning rate rises before its cosine decay. Our choice; the
# paper uses Adam at a constant 1e-5 for up to 2,000 epochs, which takes sixteen times as long, see
# `experiments.protocol`.
_WARM_UP = 0.05
# Gradients of more than this norm are scaled down to it before AdamW.
_LARGEST_GRADIENT = 1.0
# Examples of the validation part at a time, which bounds the memory.
_CHUNK = 256
# Rows from which scales and components are taken, at least, where there are as many.
_ENOUGH = 20_000
# Least time between two saved states [s].
_SAVE_EVERY = 30.0

OPTIMISER_NAMES = {"adamw": "AdamW, cosine schedule", "adam": "Adam, constant rate"}
"""The optimisers, as `model.json` names them, by what the settings call them."""

# Error from which on the size counts, in units of the spread. With a fifth ψ_high errs by a tenth
# more.
_HUBER = 0.05

Loss = Callable[[Any, PyTree, nnx.Rngs | None], Array]
"""Mean loss of a network over examples; without random streams, as in use and not in training."""


def member_seeds(seed: int, members: int) -> list[int]:
    """The seed of each member of an ensemble; that of the first is the given one.

    Args:
        seed: Seed of the training.
        members: Number of members; with more of them, the seeds of the first stay the same.
    """
    others = np.random.SeedSequence(seed).generate_state(members - 1)
    return [seed, *(int(number) >> 1 for number in others)]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Fit:
    """What training carries from epoch to epoch."""

    params: Any
    rest: Any  # state of the network that is not trained, such as running norms
    optimiser: Any
    best: Any  # params and rest with the least validation loss so far
    best_loss: Any
    best_epoch: Any


class SavedState:
    """The state of an unfinished training, in one file beside the model to be.

    A file of another training, with other data or settings, counts as none.

    Args:
        path: Where to keep it.
        identity: All that the result follows from.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any]):
        text = json.dumps(identity, sort_keys=True, default=str)
        self._path = path
        self._identity = hashlib.sha256(text.encode()).hexdigest()
        self._saved_at = time.monotonic()

    def save(self, fit: Fit, done: int, losses: Array, *, now: bool = False) -> None:
        """Saves the state after so many epochs, unless the last time was a moment ago."""
        if not now and time.monotonic() - self._saved_at < _SAVE_EVERY:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        leaves = {f"leaf{n}": np.asarray(leaf) for n, leaf in enumerate(jax.tree.leaves(fit))}
        content = io.BytesIO()
        np.savez(
            content,
            identity=np.array(self._identity),
            done=np.array(done),
            losses=np.asarray(losses),
            **leaves,  # type: ignore[arg-type]
        )
        write_bytes_atomic(self._path, content.getvalue())
        self._saved_at = time.monotonic()

    def load(self, like: Fit) -> tuple[Fit, int, np.ndarray] | None:
        """The state, the number of epochs done and their last losses; None: start anew."""
        # Whatever is wrong with the file, the training can be done without it.
        with contextlib.suppress(Exception), np.load(self._path, allow_pickle=False) as file:
            if str(file["identity"]) == self._identity:
                leaves, tree = jax.tree.flatten(like)
                found = [jnp.asarray(file[f"leaf{n}"]) for n in range(len(leaves))]
                return jax.tree.unflatten(tree, found), int(file["done"]), file["losses"]
        return None

    def remove(self) -> None:
        """Forgets the state: the model is saved."""
        self._path.unlink(missing_ok=True)


def loss_of_errors(errors: Float[Array, "*n"], loss: str) -> Float[Array, "*n"]:
    """How much each error counts in the loss, see `LOSSES`.

    Args:
        errors: Errors in units of the spread.
        loss: One of `LOSSES`. The smooth form of Huber's loss, and squares on its scale.
    """
    if loss == "squared":
        return errors**2
    return jnp.sqrt(errors**2 + _HUBER**2) - _HUBER


def even_sample(table: Mapping[str, Any]) -> dict[str, Array]:
    """Rows of a table, evenly spread over it, that are enough to take scales and components from.

    Up to 40,000 rows these are all of them.
    """
    stride = max(len(next(iter(table.values()))) // _ENOUGH, 1)
    return {name: jnp.asarray(values[::stride]) for name, values in table.items()}


def mirror_some(
    key: Array, maps: Float[Array, "n i j"], part: float = 0.5
) -> tuple[Array, Bool[Array, " n"]]:
    """Maps of which about a part is mirrored, left for right, and which ones."""
    mirrored = jax.random.bernoulli(key, part, (len(maps),))
    return jnp.where(mirrored[:, None, None], maps[:, :, ::-1], maps), mirrored


def fit_network(
    networks: Sequence[nnx.Module],
    loss: Loss,
    train: PyTree,
    validation: PyTree,
    settings: Settings,
    *,
    augment: Callable[[Array, PyTree], PyTree] | None = None,
    state: SavedState | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Any, dict[str, Any]]:
    """Fits a network to examples, or the members of an ensemble side by side.

    Members see the same examples, each in its own order. Under `vmap` they take as much processor
    time as one after the other (two cores, ψ_low of 512 units twice: 1.77 s an epoch of five), and
    are compiled once.

    Args:
        networks: Network to start from, or those of all members of an ensemble.
        loss: Loss to reduce.
        train: Examples, leaves with one leading axis.
        validation: Examples that choose among the epochs.
        settings: How long and how fast.
        augment: Changes the examples of a step at random.
        state: Where an unfinished training is kept.
        progress: Called with the number of epochs done and in all.

    Returns:
        The state with the least validation loss, of several networks stacked, and a record of the
        training.

    Raises:
        InputError: If the training diverges.
    """
    alone = len(networks) == 1
    parts = [_split(network) for network in networks]
    seeds = member_seeds(settings.seed, len(parts))
    graph = parts[0][0]
    count = len(jax.tree.leaves(train)[0])
    batch = min(settings.batch, count)
    optimiser = _optimiser(settings, settings.epochs * (count // batch))
    run_epoch: Any = partial(_epoch, graph, loss, optimiser, batch, augment)

    def start(params: Any, rest: Any) -> Fit:
        infinite = jnp.asarray(jnp.inf, jax.tree.leaves(params)[0].dtype)
        return Fit(params, rest, optimiser.init(params), (params, rest), infinite, jnp.asarray(0))

    fit: Any = [start(params, rest) for _, params, rest in parts]
    keys: Any = [jax.random.key(seed) for seed in seeds]
    if alone:
        fit, keys = fit[0], keys[0]
    else:
        run_epoch = jax.vmap(run_epoch, in_axes=(0, 0, None, None, None))
        fit, keys = jax.tree.map(lambda *leaves: jnp.stack(leaves), *fit), jnp.stack(keys)
    run_epoch = jax.jit(run_epoch)
    losses: Any = np.full((*keys.shape, 2), np.inf)
    done = 0
    if state is not None and (found := state.load(fit)) is not None:
        fit, done, losses = found
    while done < settings.epochs and not _is_converged(fit, done, settings.patience):
        fit, losses = run_epoch(fit, keys, jnp.asarray(done), train, validation)
        done += 1
        if state is not None:
            over = done == settings.epochs or _is_converged(fit, done, settings.patience)
            state.save(fit, done, losses, now=over)
        if progress is not None:
            jax.block_until_ready(losses)
            progress(done, settings.epochs)
    if not np.isfinite(fit.best_loss).all():
        raise InputError("The training diverged: use a smaller learning rate.")
    record = {
        # At most the examples there are.
        "batch": batch,
        # Fewer than the settings have where patience ended it.
        "epochs": done,
        # Numbers, or lists of them: one for each member.
        "best_epoch": (np.asarray(fit.best_epoch) + 1).tolist(),
        "best_validation_loss": np.asarray(fit.best_loss, float).tolist(),
        "last_training_loss": np.asarray(losses[..., 0], float).tolist(),
        "last_validation_loss": np.asarray(losses[..., 1], float).tolist(),
    }
    return nnx.merge_state(*fit.best), record


def _optimiser(settings: Settings, steps: int) -> optax.GradientTransformation:
    """The optimiser of a training of so many steps."""
    if settings.optimiser == "adam":
        return optax.adam(settings.learning_rate)
    rate = optax.warmup_cosine_decay_schedule(
        0.0, settings.learning_rate, int(_WARM_UP * steps), max(steps, 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(_LARGEST_GRADIENT),
        optax.adamw(rate, weight_decay=settings.weight_decay),
    )


def _is_converged(fit: Fit, done: int, patience: int) -> bool:
    """Whether the best epoch of every member lies as far back as patience goes."""
    return patience > 0 and bool((done - 1 - np.asarray(fit.best_epoch) >= patience).all())


def _epoch(
    graph: Any,
    loss: Loss,
    optimiser: optax.GradientTransformation,
    batch: int,
    augment: Callable[[Array, PyTree], PyTree] | None,
    fit: Fit,
    key: Array,
    number: Array,
    train: PyTree,
    validation: PyTree,
) -> tuple[Fit, Array]:
    """One pass over the shuffled examples; the fit, and training and validation loss."""
    order_key, step_key = jax.random.split(jax.random.fold_in(key, number))
    count = len(jax.tree.leaves(train)[0])
    steps = count // batch
    # What does not fill a batch is left out, of each epoch another part.
    order = jax.random.permutation(order_key, count)[: steps * batch].reshape(steps, batch)

    def loss_of(params: Any, rest: Any, examples: PyTree, key: Array) -> tuple[Array, Any]:
        # A copy: running norms may not be written to in the module that was traced outside.
        network = nnx.merge(graph, params, rest, copy=True)
        value = loss(network, examples, nnx.Rngs(key))
        return value, _split(network)[2]

    def step(carry: Any, inputs: tuple[Array, Array]) -> tuple[Any, Array]:
        params, rest, state = carry
        which, key = inputs
        examples = jax.tree.map(lambda leaf: leaf[which], train)
        augment_key, loss_key = jax.random.split(key)
        if augment is not None:
            examples = augment(augment_key, examples)
        (value, rest), gradient = jax.value_and_grad(loss_of, has_aux=True)(
            params, rest, examples, loss_key
        )
        updates, state = optimiser.update(gradient, state, params)
        return (optax.apply_updates(params, updates), rest, state), value

    (params, rest, state), losses = jax.lax.scan(
        step, (fit.params, fit.rest, fit.optimiser), (order, jax.random.split(step_key, steps))
    )
    value = _mean_loss(nnx.merge(graph, params, rest), loss, validation)
    better = value < fit.best_loss
    best = jax.tree.map(partial(jnp.where, better), (params, rest), fit.best)
    return (
        Fit(
            params,
            rest,
            state,
            best,
            jnp.where(better, value, fit.best_loss),
            jnp.where(better, number, fit.best_epoch),
        ),
        jnp.stack([losses.mean(), value]),
    )


def _mean_loss(network: Any, loss: Loss, examples: PyTree) -> Array:
    """The loss over many examples, a chunk at a time."""
    count = len(jax.tree.leaves(examples)[0])
    starts = range(0, count, _CHUNK)
    parts = [jax.tree.map(lambda leaf, s=s: leaf[s : s + _CHUNK], examples) for s in starts]
    sizes = [len(jax.tree.leaves(part)[0]) for part in parts]
    values = [loss(network, part, None) for part in parts]
    return jnp.asarray(sum(n * value for n, value in zip(sizes, values, strict=True)) / count)


def _split(network: nnx.Module) -> tuple[Any, Any, Any]:
    """Structure, trained weights, and the rest of the state."""
    parts: tuple[Any, ...] = nnx.split(network, nnx.Param, ...)
    return parts[0], parts[1], parts[2]
