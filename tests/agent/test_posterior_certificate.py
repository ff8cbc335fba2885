"""A certificate from counts is true as often as it says, and is never called proved."""

import json
from pathlib import Path

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.report.page import write
from pgts_torch.experiment.run import train
from pgts_torch.experiment.summary import describe
from pgts_torch.options import Counts, StepsHorizon, UniformReplay
from pgts_torch.tabular import exact, random_mdp

SHORT = {
    "depth": 8,
    "replay": UniformReplay(updates_per_step=0.01, length=8),
    "horizon": StepsHorizon(length=100, first=20),
}
COUNTS = Counts(certificate=0.95, value_range=[0.0, 10.0], strength=2.0)


def trained(seed: int, steps: int, **arguments) -> tuple[PGTS, list[float | None]]:
    mdp = {"num_states": 6, "num_actions": 2, "branching": 2, "seed": seed, "gamma": 0.9, "start": [None, 0][seed % 2]}
    training, made = PGTS("pgts/Random-v0", env_kwargs=mdp, seed=seed, **SHORT, **arguments), []
    training.learn(steps, callback=lambda _, iteration: made.append(iteration.posterior))
    return training, made


def gap(training: PGTS) -> float:
    mdp = random_mdp(**training.source.make_one().spec.kwargs)
    return exact.optimal(mdp).J - exact.evaluate(mdp, training.policy_table()).J


@pytest.mark.usefixtures("unchecked_shapes")  # for speed
@pytest.mark.parametrize(
    ("runs", "may_fail", "stop_at"),
    [(3, 1, 4.0), pytest.param(200, 18, 2.0, marks=pytest.mark.long)],
)
def test_a_training_that_ends_by_its_certificate_is_as_good_as_that_says(runs, may_fail, stop_at):
    true, ended = [], []
    for seed in range(runs):
        training, made = trained(seed, 600, model=COUNTS, stop_at=stop_at)
        ended.append(made[-1] is not None and made[-1] <= stop_at)
        true.append(gap(training) <= (made[-1] if ended[-1] else training.posterior.now()) + 1e-9)
    # What 95 % allows with an error probability of at most 1 %: at least 91 % of 200.
    assert runs - sum(true) <= may_fail
    assert 0 < sum(ended)


def test_a_certificate_is_made_whenever_a_tenth_more_steps_were_taken_and_changes_no_bit_of_a_training():
    with_it, made = trained(0, 300, model=COUNTS)
    without, none = trained(0, 300, model=COUNTS.model_copy(update={"certificate": None}))
    assert with_it.policy_table().equal(without.policy_table())
    assert none == [None] * len(made)
    assert 2 <= sum(bound is not None for bound in made) < len(made)
    assert all(bound <= 10 * (1 + 1e-9) for bound in made if bound is not None)
    assert made[0] > 9 > with_it.posterior.now() > 0


def test_a_saved_training_goes_on_to_the_same_certificate(tmp_path):
    whole = trained(1, 200, model=COUNTS)[0]
    trained(1, 100, model=COUNTS)[0].save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt").learn(200)
    assert loaded.posterior.start_count_S.equal(whole.posterior.start_count_S)
    assert loaded.posterior.now() == whole.posterior.now()
    assert whole.posterior.start_count_S.tolist() == [2, 0, 0, 0, 0, 0]  # episodes of 100 steps
    state = loaded.state_dict()
    state["posterior"]["start_count"] = torch.tensor([-1, 2])
    with pytest.raises(PgtsError, match="posterior does not fit: start_count is no count of each of the 6 states"):
        loaded.load_state_dict(state)


FROZEN = ["--env.id", "FrozenLake-v1", "--total_steps", "40", "--search.depth", "3", "--eval.episodes", "2"]


def test_a_run_says_what_its_certificate_is_and_says_nothing_of_one_that_it_has_not(tmp_path):
    def run(name: str, *more: str):
        folder = tmp_path / name
        summary = train(load(None, [*FROZEN, *more, "--run.dir", str(folder), "--run.tensorboard", "false"]))
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        return summary, describe(summary), [line.get("search/certificate_posterior") for line in lines]

    asked = "{type: counts, certificate: 0.9, value_range: [0, 1]}"
    summary, text, logged = run("asked", "--model", asked)
    assert (summary.certificate_trust, summary.certificate_confidence) == ("posterior", 0.9)
    assert f"{summary.certificate:.3g} (posterior, 90 %)" in text
    assert "proved" not in text
    answer = write(tmp_path / "asked", None)
    assert (answer["certificate"]["trust"], answer["certificate"]["bound"]) == ("posterior", summary.certificate)
    page = Path(answer["page"]).read_text()
    assert "posterior probability model.certificate" in page
    assert "is a proof" not in page
    assert any(value is not None for value in logged)
    assert summary.certificate >= summary.J_optimal - summary.J if summary.J_optimal is not None else True
    summary, text, logged = run("ended", "--model", asked, "--search.stop_at", "1.0")
    assert (summary.ended_by, summary.env_steps < 40) == ("certificate", True)
    assert "an estimated certificate" in text
    summary, text, logged = run("silent", "--model", "counts")
    assert (summary.certificate, summary.certificate_trust, summary.certificate_confidence) == (None, None, None)
    assert "certificate" not in text
    assert logged == [None] * len(logged)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (
            {"stop_at": 0.1},
            r"stop_at is 0\.1, .* model\.type counts is learned and proves none: give model\.certificate$",
        ),
        (
            {"model": {"type": "counts", "certificate": 0.9}},
            r"model\.certificate is 0\.9, which needs model\.value_range",
        ),
        ({"model": {"type": "counts", "certificate": 1.0}}, r"model\.certificate is 1\.0; it must be .* in \(0, 1\)"),
        (
            {"model": Counts(certificate=0.9, value_range=[0.0, 0.5])},
            r"such a step leads out of it, which certificate rules out: widen it",
        ),
    ],
)
def test_a_certificate_that_cannot_be_made_is_refused_in_one_line(arguments, match):
    with pytest.raises(PgtsError, match=match) as refusal:
        PGTS("FrozenLake-v1", **({"model": "counts", "depth": 4} | arguments)).learn(500)
    assert "\n" not in str(refusal.value)


def test_an_ensemble_has_no_certificate():
    with pytest.raises(PgtsError, match=r"model\.type ensemble is learned .*: only one of type counts has bounds"):
        PGTS("CartPole-v1", model="ensemble", stop_at=1.0)
