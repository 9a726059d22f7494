"""Losses of TorchRL that step 2 learns by, and one iteration by a loss: traced once, and replayed as a flat graph."""

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, cast

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.nn.utils import get_total_norm
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import CrossQLoss, DDPGLoss, LossModule, REDQLoss, SACLoss, TD3Loss

if TYPE_CHECKING:
    from rt_torchrl.steps.learn import ActorCritic, Adam

OF_ACTOR = ("loss_actor", "loss_alpha")
"""Losses that train the policy; all others train critics."""
ACTOR = ("actor_network", "log_alpha")
"""Beginnings of the names of the weights that these move; all others are those of critics."""


class LearningMethod(NamedTuple):
    """A model-free method: the loss, and what it needs.

    Args:
        make_loss: function of actor and critics, in the form that TorchRL's losses take, that makes the loss. Actions
            are scaled to [−1, 1].
        critics: number of critics.
        stochastic: whether the actor is a distribution around π_mf, whose spread is learned, too.
        delay: number of critic iterations for each iteration of policy and targets; 0 makes all iterations of the
            critic first, each with one of its target, and then those of the policy, as the paper does.
        squared: whether the loss reports δ² as ``td_error``, and not |δ|.
        normalised: whether the layers of the critics are normalised over a batch.
        relaxed: whether it is as the paper prints it: a critic without targets takes only the share τ of each of its
            steps, there are no importance weights, and the policy's gradient has no limit.
        draws: whether the loss draws random numbers.
    """

    make_loss: Callable[[TensorDictModuleBase, list[ValueOperator]], LossModule]
    critics: int = 1
    stochastic: bool = False
    delay: int = 1
    squared: bool = True
    normalised: bool = False
    relaxed: bool = False
    draws: bool = True


def ddpg_loss(actor: TensorDictModuleBase, critics: list[ValueOperator], *, target: bool = True) -> LossModule:
    """DDPG, the paper's method (section 4.1), with a target of the critic or without one, as its line 17 has it."""
    return DDPGLoss(actor, critics[0], loss_function="l2", delay_value=target)


def entropic(loss: Callable[..., LossModule]) -> Callable[[TensorDictModuleBase, list[ValueOperator]], LossModule]:
    """A loss that prices the entropy of scaled actions: SAC, CrossQ or REDQ."""

    def make(actor: TensorDictModuleBase, critics: list[ValueOperator]) -> LossModule:
        n_a = cast(ProbabilisticActor, actor).spec["action"].shape[-1]
        options = {"num_qvalue_nets": len(critics), "loss_function": "l2", "target_entropy": -float(n_a)}
        instance = loss(actor, critics, alpha_init=0.1, **options)
        float(instance.target_entropy)  # REDQ registers it when it is first read, too late for a state that is loaded
        return instance

    return make


METHODS: dict[str, LearningMethod] = {
    "ddpg": LearningMethod(ddpg_loss, delay=0, draws=False),
    "relaxed_ddpg": LearningMethod(functools.partial(ddpg_loss, target=False), delay=0, relaxed=True, draws=False),
    # The lower of two values at smoothed target actions (Fujimoto, van Hoof, Meger, ICML 2018).
    "td3": LearningMethod(functools.partial(TD3Loss, bounds=(-1.0, 1.0), loss_function="l2"), critics=2, delay=2),
    "sac": LearningMethod(entropic(SACLoss), critics=2, stochastic=True, squared=False),
    "crossq": LearningMethod(entropic(CrossQLoss), critics=2, stochastic=True, squared=False, normalised=True),
    "redq": LearningMethod(entropic(REDQLoss), critics=4, stochastic=True),
}
"""The methods that a configuration can name."""


Key = str | tuple[str, ...]
NEXT: tuple[Key, ...] = tuple(("next", key) for key in ("observation", "reward", "done", "terminated"))
TRANSITION: tuple[Key, ...] = ("observation", "action", *NEXT)
BATCH: tuple[Key, ...] = (*TRANSITION, "steps_to_next_obs", "priority_weight")
"""What a loss reads of a batch."""


@torch.enable_grad()
def iteration(learner: "ActorCritic", kind: str, *batch: Tensor) -> dict[str, Tensor]:
    """One iteration as TorchRL and torch make it: loss, gradients, steps of the optimisers and of the targets.

    Args:
        learner: learner whose weights change.
        kind: ``critic``, ``actor`` or ``both``.
        batch: tensors of a batch, in the order of ``BATCH``.

    Returns:
        Loss, errors |δ| of the transitions and their mean, value, and norms of the gradients, by name.
    """
    critic, method = kind != "actor", learner.method
    transitions = TensorDict(dict(zip(BATCH, batch, strict=True)), batch_size=[len(batch[0])])
    losses = {key: loss for key, loss in learner.loss(transitions).items() if key.startswith("loss_")}
    results: dict[str, Tensor] = {}
    steps = list[tuple["Adam", list[Tensor]]]()
    if critic:
        loss = torch.stack([loss for key, loss in losses.items() if key not in OF_ACTOR]).sum()
        gradients = slopes(loss, learner.critic_adam.weights)
        errors = learner.sizes(transitions["td_error"].detach())
        results |= {"critic_loss": loss.detach(), "errors": errors, "td_error": errors.mean()}
        results["critic_gradient"] = get_total_norm(gradients)
        steps.append((learner.critic_adam, gradients))
    if kind != "critic":
        loss = torch.stack([loss for key, loss in losses.items() if key in OF_ACTOR]).sum()
        gradients = slopes(loss, learner.actor_adam.weights)
        norm = get_total_norm(gradients)
        share = ((math.inf if method.relaxed else LIMIT) / (norm + TINY)).clamp(max=1.0)
        results |= {"value": -losses["loss_actor"].detach(), "actor_gradient": norm}
        steps.append((learner.actor_adam, [(gradient * share).to(gradient.dtype) for gradient in gradients]))
    relaxed = learner.critic_adam.weights if critic and method.relaxed else []
    before = [weight.detach().clone() for weight in relaxed]
    for optimiser, gradients in steps:
        optimiser.descend(gradients)
    with torch.no_grad():
        for weight, earlier in zip(relaxed, before, strict=True):  # w ← τ w + (1 − τ) w'
            weight.copy_(torch.lerp(earlier, weight, learner.config.target_rate))
    if learner.target is not None and critic and (kind == "both" or method.delay == 0):
        learner.target.step()
    return results


@torch.no_grad()
def traced(learner: "ActorCritic", kind: str, batch: Sequence[Tensor]) -> Callable[..., dict[str, Tensor]]:
    """The iteration of batches like this one as a flat graph, or as it is where it cannot be traced.

    The graph holds weights, moments and targets by reference; a batch is its input. What a policy has beside its
    weights and buffers, such as numbers in attributes, is read now. Nothing is changed.
    """
    eager, device = functools.partial(iteration, learner, kind), learner.generator.device
    state = [*learner.loss.parameters(), *learner.loss.buffers()]
    state += [*learner.critic_adam.parts, *learner.actor_adam.parts]
    before = [part.detach().clone() for part in state]
    try:
        with torch.random.fork_rng(devices=[device] if device.type != "cpu" else []):
            return flat(make_fx(eager)(*batch))
    except RuntimeError as error:
        policy = type(learner.policy).__name__
        warnings.warn(f"Step 2 is slower, because {policy} cannot be traced: {error}", stacklevel=4)
        return eager
    finally:
        for part, saved in zip(state, before, strict=True):
            part.copy_(saved)


LIMIT = 1.0
"""Greatest norm of the policy's gradient."""
TINY = 1e-6
"""Number that ``torch.nn.utils.clip_grad_norm_`` adds to a norm."""


def slopes(loss: Tensor, weights: list[nn.Parameter]) -> list[Tensor]:
    """The gradient of a loss by each of some weights; zero where the loss does not depend on one."""
    return list(torch.autograd.grad(loss, weights, retain_graph=True, allow_unused=True, materialize_grads=True))


PASSED = (torch.ops.aten.detach.default, torch.ops.aten.alias.default)
"""What changes nothing where no gradients are asked for."""


def flat(module: GraphModule) -> Callable[..., dict[str, Tensor]]:
    """The function of a traced module, without what changes nothing and what nobody reads.

    Weights and other tensors that the module holds become arguments, because each access to them costs as much as a
    small operation.
    """
    graph = module.graph
    for node in reversed(graph.nodes):
        if getattr(node.target, "namespace", "") == "profiler":  # marks of the optimisers' steps
            graph.erase_node(node)
        elif node.target in PASSED:
            node.replace_all_uses_with(node.all_input_nodes[0])
    graph.eliminate_dead_code()
    held = [node for node in graph.nodes if node.op == "get_attr"]
    with graph.inserting_before(next(iter(graph.nodes))):
        for number, node in enumerate(held):
            node.replace_all_uses_with(graph.placeholder(f"held_{number}"))
    tensors = [getattr(module, node.target).detach() for node in held]
    for node in held:
        graph.erase_node(node)
    return functools.partial(GraphModule(nn.Module(), graph).forward, *tensors)
