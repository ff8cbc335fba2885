"""Algorithm 1 for many settings at once, and from samples."""

import dataclasses
import json
from concurrent.futures import Future

import numpy as np
import pytest
import torch

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import ascent, exact, ladder, mirage
from study import command, figure, random_mdp, sampled
from study.curves import arrivals, initial_policy, trace
from study.figure import Effort
from study.tests.made_up import made_up, smallest
from tests.support import always, random_policy, zoo

LEFT = 0


@pytest.mark.parametrize("name", ["ladder", "tightrope", "random, dense", "grid", "deep_sea"])
@pytest.mark.parametrize("update", [ascent.projected_step, ascent.softmax_step])
def test_many_settings_at_once_are_algorithm_1_one_by_one(name, update):
    mdp, depths, steps = zoo(name), (0, 1, 4), (0.05, 2.0)
    pi_SA = random_policy(mdp)
    if update is ascent.projected_step:
        pi_SA[: mdp.num_states // 2] = always(mdp, LEFT)[: mdp.num_states // 2]  # some states are never visited
    found = trace(mdp, pi_SA, depths=depths, steps=steps, iterations=6, update=update)
    for m in depths:
        for step in steps:
            one = ascent.ascend(mdp, pi_SA, depth=m, step_size=step, iterations=6, step=update)
            torch.testing.assert_close(found[m, step].J_K, one.J_K, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(found[0, 0.05].J_K, found[4, 2.0].J_K, rtol=1e-6)


def test_arrivals_are_those_of_the_whole_curves():
    mdp = ladder(start=None)
    settings = {"depths": (0, 2, 4), "steps": (0.01, 0.1)}
    pi_SA = always(mdp, LEFT)
    curves = trace(mdp, pi_SA, iterations=40, **settings)
    found = arrivals(mdp, pi_SA, limit=40, **settings)
    assert found == {setting: run.arrival for setting, run in curves.items()}
    assert found[4, 0.1] == 8
    assert found[0, 0.01] is None


def test_arrival_is_99_percent_of_the_way_also_where_returns_are_negative():
    assert made_up(-45, -18.6, -18.4, J_optimal=-18.225).arrival == 2
    assert made_up(0, 9.89, 9.91).arrival == 2
    assert made_up(0, 9.89).arrival is None


def test_on_the_mirage_every_level_of_depth_is_slower():
    mdp = mirage()
    depths = (0, 1, 5, 20, 50)
    found = arrivals(mdp, always(mdp, LEFT), depths=depths, steps=[0.03], limit=200)
    times = [found[m, 0.03] for m in depths]
    assert times == sorted(times)
    assert times[-1] > 10 * times[0]


def test_a_band_is_the_interquartile_mean_inside_its_interval():
    J_NK = numpy_stream(1, "band").normal(size=(10, 4)) + np.arange(4)
    found = sampled.band(J_NK, "test")
    assert found.iqm == pytest.approx([np.sort(column)[2:-2].mean() for column in J_NK.T])
    assert all(low < iqm < high for low, iqm, high in zip(found.low, found.iqm, found.high, strict=True))
    assert sampled.band(J_NK, "test") == found
    one = sampled.band(J_NK[:1], "test")
    assert one.low == one.iqm == one.high == J_NK[0].tolist()


@pytest.mark.usefixtures("unchecked_shapes")
def test_runs_are_independent_and_the_number_of_workers_changes_nothing():
    given = figure.sampled_arguments(smallest(random_mdp.FIGURE), "projected", "uniform", 1)
    jobs = [sampled.Job(("test", seed), "pgts/Random-v0", 2, given) for seed in range(2)]
    with sampled.executor(0) as here, sampled.executor(1) as elsewhere:
        found = [[one.submit(sampled.returns, job).result() for job in jobs] for one in (here, elsewhere)]
    assert found[0] == found[1]
    assert found[0][0][0] == found[0][1][0]
    assert found[0][0][-1] != found[0][1][-1]
    assert len(found[0][0]) == 3


def test_sampled_runs_use_the_initial_policy_of_the_exact_ones():
    for one in command.CURVES.values():
        panel = figure.panel(one, "projected", "s0")
        mdp = one.make(start=0)
        J = exact.evaluate(mdp, initial_policy(mdp, one.moves["projected"].init)).J
        assert panel["exact"]["0"][0] == pytest.approx(J, rel=1e-5)


def test_what_was_computed_twice_is_the_same_and_another_figure_is_not():
    def computed(one: figure.Figure) -> str:
        effort = Effort(quick=True, seeds=2, workers=0)
        runs = figure.start(one, effort, sampled.Here())
        return json.dumps(figure.finish(one, effort, runs, lambda message: None)["panels"])

    shown = smallest(random_mdp.FIGURE)
    assert computed(shown) == computed(shown)
    assert computed(shown) != computed(dataclasses.replace(shown, name="other"))


def test_an_executor_of_no_processes_answers_at_once():
    future = sampled.executor(0).submit(max, 1, 2)
    assert isinstance(future, Future)
    assert future.result() == 2
