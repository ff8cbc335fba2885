"""How noisy is an estimate of the gradient, and where does it point, by depth?

    python benchmarks/variance.py [--json FILE] [--picture FILE] [--quick]

One estimate is made of 16 episodes of one policy: the direction in the logits of a tabular softmax policy,

    g(s, a) = w(s) pi(a|s) (q(s, a) - <pi(.|s), q(s, .)>),     w(s) = discounted visits an episode ~ d^pi(s)

with q from the actions taken (REINFORCE: discounted rewards to go; GAE, lambda 0.95), or T^m Q of a critic for all
actions. The critic is a table, TD(0.9) with step size 0.5 on four earlier rollouts of 16 episodes of the same policy,
fitted again for each estimate; or the exact v^pi. Episodes are cut where gamma^t falls below 1 %, later rewards count
as 0 for REINFORCE. Directions:

    ascent      the exact gradient of J, d^pi and Q^pi exact
    wanted      what the estimate is one of: d^pi and T^m Q^pi exact; for REINFORCE and GAE the gradient of J

Policies: uniform; and softmax(Q* / tau), with tau such that its return is half way from the uniform one to J*.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common
import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from pgts_torch.agent.advantages import gae, lambda_returns, score_function
from pgts_torch.agent.collect import rollout
from pgts_torch.agent.critics import TabularCritic
from pgts_torch.agent.policies import SoftmaxPolicy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.bellman import backup
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.options import FixedHorizon, TabularValues, TDLambda
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, random_mdp
from pgts_torch.tabular.ascent import softmax_direction

EPISODES, EARLIER, STEP_SIZE, GAE_LAMBDA = 16, 4, 0.5, 0.95
DEPTHS = (0, 1, 2, 4, 8)
LEFT_OUT = 0.01
RESAMPLES, TAIL = 1000, 0.025
NAMES = ("REINFORCE", "GAE", *(f"m = {depth}" for depth in DEPTHS))

Figures = dict[str, list[float | None]]


def cliff_walking() -> TabularMDP:
    return TabularMDP.from_gymnasium(gymnasium.make("CliffWalking-v1"), 0.99)


MDPS = {
    "Grid": lambda: grid(start=0),
    "FrozenLake8x8": common.frozen_lake,
    "CliffWalking": cliff_walking,
    "DeepSea(10)": lambda: deep_sea(10),
    "Garnet(200,4,5)": lambda: random_mdp(200, 4, branching=5),
}


def half_way(mdp: TabularMDP) -> Float[Tensor, "S A"]:
    """softmax(Q* / tau) whose return is the mean of the uniform policy's and J*, by bisection in log tau."""
    best = exact.optimal(mdp)
    aim = (common.uniform_evaluation(mdp).J + best.J) / 2
    cold, hot = math.log(1e-6), math.log(1e6)
    for _ in range(60):
        middle = (cold + hot) / 2
        better = exact.evaluate(mdp, (best.q_SA / math.exp(middle)).softmax(-1)).J > aim
        cold, hot = (middle, hot) if better else (cold, middle)
    return (best.q_SA / math.exp(cold)).softmax(-1)


def softmax_policy(pi_SA: Float[Tensor, "S A"]) -> SoftmaxPolicy:
    policy = SoftmaxPolicy(*pi_SA.shape)
    policy.load_state_dict({"logits_SA": pi_SA.clamp(min=1e-300).log()})
    return policy


def columns(episodes: Rollout, chosen: slice) -> Rollout:
    """Some of the episodes."""
    given = {name: value for name, value in vars(episodes).items() if value is not None}
    return replace(episodes, **{name: value[:, chosen] for name, value in given.items()})


@dataclass(frozen=True)
class Estimates:
    """Independent estimates of one direction, one a row, and the directions that they are held to."""

    estimate_RD: Float[np.ndarray, "R D"]
    wanted_D: Float[np.ndarray, "D"]
    ascent_D: Float[np.ndarray, "D"]

    def figures(self) -> Figures:
        """Each as [value, lower end, upper end] of its 95 % bootstrap interval over estimates.

        With mu the mean of an estimate, from products of *different* estimates, which have no noise of their own:
            |mu|^2 = mean_{i != j} <g_i, g_j>,   trace of the covariance = mean_i |g_i|^2 - |mu|^2

        variance: that trace by the squared norm of the gradient of J.   noise: by |mu|^2.
        norm: |mu| by the norm of the gradient of J.
        to_wanted, to_ascent: cosine of mu to these directions.
        single_wanted, single_ascent: the mean cosine of single estimates.
        None three times where a resample knows no |mu|: the mean is lost in the noise.
        """
        gram_RR = self.estimate_RD @ self.estimate_RD.T
        R = len(gram_RR)
        rows_YR = np.random.default_rng(0).integers(R, size=(RESAMPLES, R))
        count_YR = np.stack([np.bincount(rows, minlength=R) for rows in rows_YR])
        count_YR = np.concatenate([np.ones((1, R)), count_YR])
        own_R = gram_RR.diagonal()
        pairs_Y = R**2 - (count_YR**2).sum(-1)
        square_Y = (((count_YR @ gram_RR) * count_YR).sum(-1) - (count_YR**2) @ own_R) / pairs_Y
        trace_Y = count_YR @ own_R / R - square_Y
        length_Y = np.sqrt(np.where(square_Y > 0, square_Y, np.nan))
        ascent = np.linalg.norm(self.ascent_D)
        found = {"variance": trace_Y / ascent**2, "noise": trace_Y / length_Y**2, "norm": length_Y / ascent}
        for name, direction_D in (("wanted", self.wanted_D), ("ascent", self.ascent_D)):
            along_R = self.estimate_RD @ direction_D / np.linalg.norm(direction_D)
            found[f"to_{name}"] = np.clip(count_YR @ along_R / R / length_Y, -1, 1)
            cosine_R = along_R / np.sqrt(np.where(own_R > 0, own_R, np.inf))
            found[f"single_{name}"] = count_YR @ cosine_R / R
        return {name: _with_interval(value_Y) for name, value_Y in found.items()}


def _with_interval(value_Y: Float[np.ndarray, "Y"]) -> list[float | None]:
    """The first value, and the middle 95 % of the others."""
    if not np.isfinite(value_Y).all():
        return [None] * 3
    return [float(value_Y[0]), *np.quantile(value_Y[1:], [TAIL, 1 - TAIL]).tolist()]


def measured(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], estimates: int) -> dict[str, Any]:
    """The figures of every estimator with one policy."""
    R, S, A = estimates, mdp.num_states, mdp.num_actions
    truth = exact.evaluate(mdp, pi_SA)
    policy = softmax_policy(pi_SA)
    gamma = float(mdp.outcomes.discount_NAK.max())
    horizon = FixedHorizon(length=math.ceil(math.log(LEFT_OUT) / math.log(gamma)))

    def act(num_envs: int, name: str) -> Rollout:
        env = TabularVectorEnv(mdp, num_envs, autoreset_mode=AutoresetMode.DISABLED)
        world = TabularWorld(env, mdp)
        generator = stream(0, "variance", name)
        return rollout(world, policy, horizon, seed=0, names=("variance", name), generator=generator)

    # Line r of v_RS: the critic of estimate r, which has seen episodes of its own.
    critics = [TabularCritic(S, A, TabularValues(method=TDLambda(lambda_=0.9), step_size=STEP_SIZE)) for _ in range(R)]
    for k in range(EARLIER):
        episodes = act(R * EPISODES, f"earlier {k}")
        for r, critic in enumerate(critics):
            part = columns(episodes, slice(r * EPISODES, (r + 1) * EPISODES))
            critic.fit(policy, part, generator=stream(0, "variance", "unused"))
    learned_RS = torch.stack([critic.v(torch.arange(S)) for critic in critics])
    values = {"TD critic": learned_RS, "exact critic": truth.v_S.expand(R, S)}

    now = act(R * EPISODES, "now")
    alive_TB = now.alive_TB
    owner_TB = (torch.arange(R * EPISODES) // EPISODES).expand_as(now.state_TB)
    cell_TB = owner_TB * S + now.state_TB
    weight_V = now.weight_TB[alive_TB] / EPISODES
    w_RS = torch.zeros(R * S, dtype=torch.float64).index_add_(0, cell_TB[alive_TB], weight_V).view(R, S)

    def from_actions(advantage_TB: Tensor) -> Tensor:
        state_V, pi_VA = now.state_TB[alive_TB], pi_SA[now.state_TB[alive_TB]]
        q_VA = score_function(now.action_TB[alive_TB], advantage_TB[alive_TB], pi_VA)
        direction_VA = softmax_direction(pi_VA, q_VA, weight_V)
        index_V = owner_TB[alive_TB] * S + state_V
        return torch.zeros(R * S, A, dtype=torch.float64).index_add_(0, index_V, direction_VA).view(R, -1)

    def from_all(v_RS: Tensor, depth: int) -> Tensor:
        looks = [exact.lookahead(mdp, backup(mdp.outcomes, v_S), depth) for v_S in v_RS]
        return torch.stack(
            [softmax_direction(pi_SA, q_SA, w_S).flatten() for q_SA, w_S in zip(looks, w_RS, strict=True)]
        )

    def exact_direction(depth: int) -> Float[np.ndarray, "D"]:
        look_SA = exact.lookahead(mdp, truth.q_SA, depth)
        return softmax_direction(pi_SA, look_SA, truth.d_S).flatten().numpy()

    ascent_D = exact_direction(0)
    nothing_TB = torch.zeros_like(now.reward_TB)
    rewards_TB = lambda_returns(now, nothing_TB, now.discount_TB, 1.0)
    answer = {"REINFORCE": Estimates(from_actions(rewards_TB).numpy(), ascent_D, ascent_D).figures()}
    for critic_name, v_RS in values.items():
        v_C = v_RS.reshape(-1)
        advantage_TB = gae(now, v_C[cell_TB], v_C[owner_TB * S + now.next_state_TB], GAE_LAMBDA)
        found = {"GAE": Estimates(from_actions(advantage_TB).numpy(), ascent_D, ascent_D).figures()}
        for depth in DEPTHS:
            wanted_D = exact_direction(depth)
            found[f"m = {depth}"] = Estimates(from_all(v_RS, depth).numpy(), wanted_D, ascent_D).figures()
        answer |= {f"{name}, {critic_name}": figures for name, figures in found.items()}
    return {"J": truth.J, "ascent": float(np.linalg.norm(ascent_D)), "estimators": answer}


COSINES = {
    "to_wanted": "mean:wanted",
    "to_ascent": "mean:ascent",
    "single_wanted": "one:wanted",
    "single_ascent": "one:ascent",
}


def print_figures(name: str, found: dict[str, Any]) -> None:
    print(f"\n{name}: J {found['J']:.4g}, |gradient of J| {found['ascent']:.3g}")
    print(f"{'':21}{'noise':>7}{'(interval)':>16}{'variance':>10}{'norm':>7}", end="")
    print("".join(f"{title:>14}" for title in COSINES.values()))
    for estimator, figures in found["estimators"].items():
        noise, *ends = map(_number, figures["noise"])
        line = f"{estimator:21}{noise:>7}{'(' + ', '.join(ends) + ')':>16}"
        line += f"{_number(figures['variance'][0]):>10}{_number(figures['norm'][0]):>7}"
        for column in COSINES:
            value, low, high = figures[column]
            line += ("-" if value is None else f"{value:.2f} -+ {(high - low) / 2:.2f}").rjust(14)
        print(line, flush=True)


def _number(value: float | None) -> str:
    return "-" if value is None else common.short(value) if value >= 0.1 else f"{value:.3f}"


def by_estimator(found: dict[str, Any], critic: str, what: str) -> list[float | None]:
    """One figure of REINFORCE and of what the others are with a critic, in the order of `NAMES`."""
    return [found["estimators"][NAMES[0]][what][0]] + [
        found["estimators"][f"{name}, {critic}"][what][0] for name in NAMES[1:]
    ]


def print_summary(report: dict[str, Any]) -> None:
    """Two figures for the learned critic, a line for each problem and policy."""
    for what, title in (("noise", "noise"), ("single_ascent", "one:ascent")):
        print(f"\n{title + ', TD critic':26}" + "".join(f"{name:>10}" for name in NAMES))
        for key, found in report.items():
            values = by_estimator(found, "TD critic", what)
            texts = map(_number, values) if what == "noise" else (f"{value:.2f}" for value in values)
            print(f"{key:26}" + "".join(f"{text:>10}" for text in texts))


def picture(report: dict[str, Any], path: Path) -> None:
    """Noise, and the cosine of one estimate to the gradient of J, by estimator: a column for each problem."""
    problems = list(dict.fromkeys(key.partition(", ")[0] for key in report))
    figure = Figure(figsize=(2.9 * len(problems), 5), layout="constrained")
    axes = figure.subplots(2, len(problems), sharex=True, squeeze=False)
    for key, found in report.items():
        problem, _, policy = key.partition(", ")
        column = problems.index(problem)
        for critic, line in (("TD critic", "-"), ("exact critic", ":")):
            style = {"color": "C0" if policy == "uniform" else "C1", "linestyle": line, "marker": "."}
            for row, what in enumerate(("noise", "single_ascent")):
                values = np.array(by_estimator(found, critic, what), dtype=float)
                axes[row, column].plot(values, label=f"{policy}, {critic}", **style)
        axes[0, column].set(title=problem, yscale="log")
        axes[1, column].set_xticks(range(len(NAMES)), NAMES, rotation=90)
    axes[0, 0].set_ylabel("variance / |mean|^2")
    axes[1, 0].set_ylabel("cosine of one estimate\nto the gradient of J")
    axes[1, -1].legend(fontsize="x-small")
    figure.savefig(path, dpi=100)


def main(arguments: list[str] | None = None) -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--picture", type=Path, help="where to draw the figures")
    args = parser.parse_args(arguments)
    common.use_one_core()
    estimates = 100 if args.quick else 400
    print(f"{estimates} estimates of {EPISODES} episodes each; 95 % bootstrap intervals over estimates")
    report: dict[str, Any] = {}
    for name, make in MDPS.items():
        mdp = make()
        uniform_SA = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions, dtype=torch.float64)
        for policy, pi_SA in (("uniform", uniform_SA), ("half way", half_way(mdp))):
            key = f"{name}, {policy}"
            report[key] = measured(mdp, pi_SA, estimates)
            print_figures(key, report[key])
    print_summary(report)
    print(NOTE)
    common.write({"about": common.about(args), "estimates": estimates, "figures": report}, args.json)
    if args.picture:
        picture(report, args.picture)


NOTE = """
noise: trace of the covariance by the squared norm of the mean. variance, norm: that trace and the norm of
the mean, by those of the gradient of J. mean:, one: cosine of the mean estimate, with its own noise taken out,
and mean cosine of one estimate, to the wanted direction (d^pi and T^m Q^pi exact) and to the gradient of J.
-: the mean is lost in the noise of all the estimates."""


if __name__ == "__main__":
    main()
