"""A run, which a recipe's main makes: the algorithm with its progress, dashboard, checkpoints and results."""

import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn
from torchrl.envs import EnvBase

from rt_torchrl import figures
from rt_torchrl.algorithm import ReinforcementTwinning
from rt_torchrl.atomic_file import finite, write_json
from rt_torchrl.control.classical import ClassicalController
from rt_torchrl.control.predictive_control import PredictiveControl
from rt_torchrl.evaluation.checks import engine_gap
from rt_torchrl.evaluation.optimum import exact_optimum
from rt_torchrl.evaluation.unseen import Baseline, Judged, RealController, RealEpisodes, mean_with_confidence
from rt_torchrl.figures.snapshot import Snapshot
from rt_torchrl.interruption import Interrupted, Interruption, safe_point, termination_as_interrupt
from rt_torchrl.plants.plant import Plant
from rt_torchrl.runs import results, run_start
from rt_torchrl.runs.command_line import quieten_libraries
from rt_torchrl.runs.dashboard import Dashboard, Progress
from rt_torchrl.runs.run_config import Callback, RunConfig, require_device
from rt_torchrl.runs.run_folder import RunFolder, checkpoints, load_checkpoint, save_checkpoint, save_tensors
from rt_torchrl.runs.settings import numbers_of
from rt_torchrl.runs.table import next_steps, results_table
from rt_torchrl.steps.config import ROLES, Role
from rt_torchrl.steps.hypotheses.ensemble import make_twin
from rt_torchrl.steps.learn import ActorCritic, Learner
from rt_torchrl.steps.memory import LongTermMemory
from rt_torchrl.steps.plan import MakePlanner, make_planner
from rt_torchrl.steps.start import EarlierPolicies, FirstController, first_live
from rt_torchrl.steps.switch import DecisionTree, MakeReferee
from rt_torchrl.systems.collectors import MakeCollector, collector_of
from rt_torchrl.systems.operation import Operation
from rt_torchrl.systems.preflight import check_records
from rt_torchrl.systems.real_system import RealSystem
from rt_torchrl.trajectories.trajectory import Trajectory, until_end


class Run:
    """One training with its run folder, progress, dashboard, checkpoints and results.

    A run holds its folder from its construction to the end of :meth:`train`: no other training may write there.

    Args:
        config: options of the run.
        plant: the real system in simulation, and the physics of the twin unless ``config.believed()`` names others, for
            which policies and controllers are then made.
        env: the real system, if it is not a plant in simulation, or a function that makes it, as an asynchronous run
            needs it for the process that acts. Policies are judged on ``plant`` with ``env.closure``, or
            on the twin if that closure is not known. After the training the real system flies only the
            ``config.real_unseen`` episodes of each controller that are asked for.
        baselines: controllers to judge beside the policies, on the same episodes, by name. On a real system they fly
            ``config.real_unseen`` episodes, too, and a :class:`RealController` flies these alone.
        first: class of the controller that the real system has had so far, for ``start="controller"``; it is one of the
            baselines then.
        learner: function of plant, policy, ``config.twinning.learner`` and ``generator=`` that makes the learner of
            step 2, such as a :class:`Learner` of one's own or :class:`ActorCritic` with a loss of one's own.
        replay: function of ``correction=`` and ``generator=`` that makes the memory of :class:`ActorCritic`, if there
            is no ``learner``.
        planner: function of twin, policy and ``config.twinning.planner`` that makes the planner of step 5, a
            :class:`Planner`.
        referee: function of ``config.twinning.referee`` and the role that starts live that makes the referee of step 6,
            a :class:`Referee`.
        collector: function of the real system, the live policy and the plant that makes the TorchRL collector of step
            1, each of whose batches is a whole episode of batch size ``1 n``.
        callbacks: functions that see the entries of all episodes after each one, and may end the training; see
            :data:`Callback`.

    Raises:
        PlantContractError: before any work, if a plant breaks its contract in a way that is found at once;
            ``check_plant`` also finds what takes seconds to find.
        ValueError: before any work, if a controller does not fit the plant, what ``config.start`` names does not exist
            or fit, the device does not exist, the run folder cannot be written, is in use or holds a run, the run to
            resume had other options or a damaged checkpoint, or options need a plant in simulation beside an ``env``.
    """

    def __init__(
        self,
        config: RunConfig,
        plant: Plant,
        *,
        env: RealSystem | Callable[[], RealSystem] | None = None,
        baselines: dict[str, type[Baseline]] | None = None,
        first: type[ClassicalController] | None = None,
        learner: Callable[..., Learner] | None = None,
        replay: Callable[..., LongTermMemory] | None = None,
        planner: MakePlanner = make_planner,
        referee: MakeReferee = DecisionTree,
        collector: MakeCollector = collector_of,
        callbacks: Sequence[Callback] = (),
    ):
        self.started = time.perf_counter()
        if learner is not None and replay is not None:
            raise ValueError("replay belongs to ActorCritic; give it to the learner, or leave the learner out.")
        if config.config is not None:
            raise ValueError(f"config={config.config} is for a command line; in code take load_run(folder).config.")
        quieten_libraries()  # before the check of the plant, whose Jacobians are the first to speak
        begins = config.start or ("random" if first is None else "controller")
        self.config = dataclasses.replace(config, start=begins).effective()
        self.ended: str | None = None
        self.callbacks = callbacks
        self.device = require_device(config.device)
        self._real = env if isinstance(env, RealSystem) or env is None else env()
        physics = run_start.known_physics(config, plant, self._real, first, baselines).to(self.device)
        laws = dict(baselines or {})
        if begins == "controller" and first is not None and first not in laws.values():
            laws[first.__name__ if first.__name__ not in laws else f"{first.__name__} (first)"] = first
        self._start = run_start.start_of(self.config, physics, first)
        if threads := run_start.learner_threads(config):
            torch.set_num_threads(threads)
        controllers = {name: law(physics) for name, law in laws.items()}
        flies_first = first if begins == "controller" else None
        named = {"first" if laws[name] is flies_first else name: law for name, law in controllers.items()}
        self._held = RunFolder(config, plant.name, {name: numbers_of(law) for name, law in named.items()})
        self.folder = self._held.path
        try:
            simulated = functools.partial(run_start.simulated, plant, config, first, device=self.device)
            make_env, system = None if isinstance(env, RealSystem) else env or simulated, self._real or simulated()
            self._system, make_learner = system, learner or functools.partial(ActorCritic, replay=replay)
            self._make_algorithm(system, make_env, physics, (make_learner, planner, referee, collector))
            self.unseen = run_start.judged_on(plant, self.algorithm.twin, self._real, self.config, device=self.device)
            self.baselines = {name: law.to(self.device) for name, law in controllers.items()}
            self.episodes: list[dict[str, Any]] = []
            self._paid: list[float | None] = []
            self._doubts: tuple[str, ...] = ()
            if config.resume and checkpoints(self.folder):
                self._paid = results.paid_before(self.folder)
                self.episodes = load_checkpoint(self.folder, self.algorithm)
                self.started -= sum(results.seconds_per_step(self.episodes).values())
            elif self._real is not None and config.preflight:
                self.algorithm.flights.check = self._require_wiring
        except BaseException:
            self._held.release()
            raise

    def _make_algorithm(
        self,
        env: EnvBase | Operation,
        make_env: Callable[[], EnvBase] | None,
        physics: Plant,
        makers: tuple[Callable[..., Learner], MakePlanner, MakeReferee, MakeCollector],
    ) -> None:
        config, (make_learner, planner, referee, collector) = self.config, makers
        generator = torch.Generator(device=self.device).manual_seed(config.seed)
        self.make_policy = functools.partial(config.make_policy, physics)
        policies = {role: policy.to(self.device) for role, policy in config.make_policies(physics, generator).items()}
        closure = config.make_closure(physics, generator).to(self.device)
        policies = config.acting_policies(policies, physics, closure)
        table, first = config.twinning, self._start
        if config.start == "mpc":
            first = FirstController(PredictiveControl(physics, closure, table.planner.receding_horizon))
        twin = make_twin(physics, closure, table.hypotheses, engine=config.engine)
        if isinstance(first, EarlierPolicies):
            first.hand_over(twin)
        learner = make_learner(physics, policies["model_free"], table.learner, generator=generator)
        if config.asynchronous:
            env = run_start.operation_of(config, env, make_env, physics, policies, first=first)
        self.algorithm = ReinforcementTwinning(
            env,
            twin,
            **policies,
            config=table,
            generator=generator,
            learner=learner,
            planner=planner(twin, policies["model_based"], table.planner),
            referee=referee(table.referee, first_live(table.arm, first)),
            first=first,
            make_collector=collector,
            make_policy=self.make_policy,
        )
        # Copies made after the algorithm know its learner's critic, where model predictive control needs one.
        self.initial_policies, self.initial_closure = copy.deepcopy(policies), copy.deepcopy(closure)

    def _require_wiring(self, record: Trajectory) -> None:
        """Refuse a real system whose first flight shows a mistake in its wiring, and keep the doubts for the report."""
        wiring = check_records([record], self.algorithm.twin.plant, self.initial_closure)
        wiring.require()
        self._doubts = wiring.doubts

    def train(self) -> dict[str, Any]:
        """Train, evaluate and write the results.

        Ctrl-C or SIGTERM ends the training after the present iteration; the evaluation then takes the episodes done so
        far. It ends flights of the real system that follow, too. A second one, or one elsewhere after the training,
        ends the run at once; the run can then be resumed.

        Returns:
            Content of ``metrics.json``.

        Raises:
            KeyboardInterrupt: if Ctrl-C or SIGTERM ended the run at once.
            OSError: if a file cannot be written, such as on a full disk; what was done before is saved.
            ValueError: if another training has taken the folder since an earlier call of this method.
        """
        self._held.hold()
        try:
            with termination_as_interrupt():
                return self._train()
        except (KeyboardInterrupt, OSError) as error:
            if self.episodes:
                how = "ended at once" if isinstance(error, KeyboardInterrupt) else "stopped"
                done = len(self.episodes)
                print(f"{how}: {done} episodes done are in {self.folder}; --resume goes on with them")
            raise
        finally:
            self._end_operation()
            self._held.release()

    def _end_operation(self) -> None:
        """End the operation of the real system, if it operates while the algorithm learns."""
        if self.algorithm.operating is not None:
            self.algorithm.operating.operation.close()

    def _train(self) -> dict[str, Any]:
        self._held.begin(self.config)
        dashboard = Dashboard(self.folder)
        with Progress(self.config.episodes, len(self.episodes)) as bar:
            bar.doing("checking the gradient")
            # Model predictive control has no weights of its own whose gradient could be checked.
            checked: Role = "model_free" if self.config.twinning.planner.method == "receding_horizon" else "model_based"
            engine, physics = self.config.engine, self.algorithm.twin.plant
            gap = engine_gap(physics, self.initial_closure, self.initial_policies[checked], self.unseen, engine)
            self._all_episodes(dashboard, bar)
            if not self.episodes:
                raise Interrupted("interrupted before the first episode was done; nothing to report.")
            if self.algorithm.episodes_done != len(self.episodes) or len(self.episodes) < self.config.episodes:
                self.episodes = load_checkpoint(self.folder, self.algorithm)  # as the last whole episode has left it
            self._end_operation()
            recalled = self.algorithm.conclude()
            if recalled:
                bar.write("real episodes contradict the twin: the last plan, which no flight has tried, does not stay")
            bar.doing("judging on unseen episodes")
            began = time.perf_counter()
            laws = {name: law for name, law in self.baselines.items() if not isinstance(law, RealController)}
            flights = results.flights_of(self.unseen, self.algorithm.policies, laws)
            judged = {name: self.unseen.judge(flown) for name, flown in flights.items()}
            refusals = results.refused(self.algorithm)
            real = self._fly_the_real_system(bar, refusals)
            judging = time.perf_counter() - began
            begun = self.initial_policies, self.initial_closure
            summary = results.summarise(self.algorithm, self.unseen, flights, judged, *begun, refusals)
            summary |= {"engine_gap": gap, "recalled": recalled, "ended": self.ended}
            summary |= {} if real is None else {"real_unseen": real}
            metrics = self._written(summary, judged, judging)
            if self.config.figures:
                bar.doing("drawing the figures")
                dashboard.images(self._drawn(flights, judged), len(self.episodes))
        table = results_table(metrics)
        dashboard.results(metrics["summary"], table)
        dashboard.close()
        print(table)
        print(f"results in {self.folder}\n{next_steps(metrics, self.folder, self.config)}")
        return metrics

    def _all_episodes(self, dashboard: Dashboard, bar: Progress) -> None:
        """Make the remaining episodes, or as many of them as are done when Ctrl-C is pressed."""
        with Interruption() as interruption:
            try:
                while len(self.episodes) < self.config.episodes:
                    safe_point()
                    self._episode(dashboard, bar)
                    bar.episode(self.episodes[-1])
                    self.ended = "; ".join(reason for tell in self.callbacks if (reason := tell(self.episodes))) or None
                    if self.ended is not None:
                        bar.write(f"ended after {len(self.episodes)} episodes: {self.ended}")
                        break
            except KeyboardInterrupt:
                if interruption.at_once:
                    raise
                bar.write(f"interrupted: going on with the {len(self.episodes)} episodes done (again to end at once)")

    def _episode(self, dashboard: Dashboard, bar: Progress) -> None:
        number = len(self.episodes) + 1
        record = results.episode_record(self.algorithm.episode(bar.doing), episode=number)
        record |= results.twin_entries(self.algorithm.twin) | results.first_there(self.algorithm)
        if self._doubts:
            record["doubts"], self._doubts = list(self._doubts), ()
        if self.algorithm.flights.faults:
            record["faults"] = [fault._asdict() for fault in self.algorithm.flights.faults]
            for fault in self.algorithm.flights.faults:
                bar.write(f"episode {record['episode']}, {fault.time:g} s: {fault.kind}: {fault.detail}")
        interval = self.config.unseen_every
        if interval and number % interval == 0:
            acting = self.algorithm.policies[self.algorithm.referee.live]
            key = "J_a_unseen_on_the_twin" if self.unseen.judged_on == "twin" else "J_a_unseen"
            record[key] = self.unseen.control_costs(acting).mean().item()
        save_checkpoint(self.folder, self.algorithm, [*self.episodes, record])
        self.episodes.append(record)
        dashboard.episode(record)

    def _fly_the_real_system(self, bar: Progress, refusals: Mapping[Role, str]) -> dict[str, Any] | None:
        """The entry ``real_unseen`` of the summary; that of an earlier end, unless other flights are asked for.

        Before the first flight the run says how many of whom. Who has pressed Ctrl-C does not want the system to go on.
        """
        count, live = self.config.real_unseen, self.algorithm.referee.live
        interrupted = len(self.episodes) < self.config.episodes and self.ended is None
        earlier = results.judged_before(self.folder, self.episodes)
        if not count or interrupted:
            return earlier
        laws: dict[str, nn.Module] = {live: self.algorithm.policies[live], **self.baselines}
        if reason := results.grounded(self.config, self.algorithm, self.initial_policies, refusals):
            bar.write(f"the live policy does not fly the real system: {reason}")
            del laws[live]
        flown = {} if earlier is None else {name: law["episodes"] for name, law in earlier["controllers"].items()}
        if earlier is not None and flown == dict.fromkeys(laws, count):
            bar.write("the real system has been flown after these episodes; it is not flown again")
            return earlier
        names = ", ".join(f"{count} of {name}" for name in laws)
        bar.write(f"{count * len(laws)} flights on the real system, which count as paid: {names}")
        bar.doing("judging on the real system")
        episodes = RealEpisodes(self._system, count, physics=self.unseen.physics, device=self.device)
        episodes.bounds = self.unseen.bounds
        flights = self._real_flights(episodes, laws, bar)
        self._paid += episodes.paid
        if not flights:
            return earlier
        judged = {name: episodes.judge(flown) for name, flown in flights.items()}
        entry = results.entries(episodes, flights, judged, live)
        if live in flights:
            J_p, before = results.twin_costs(episodes, self.algorithm, self.initial_closure, flights[live])
            entry |= {"J_p": mean_with_confidence(J_p), "J_p_before": mean_with_confidence(before)}
        return entry

    def _real_flights(
        self, episodes: RealEpisodes, laws: Mapping[str, nn.Module], bar: Progress
    ) -> dict[str, Trajectory]:
        """The flights of each controller, without those that fail, and without what comes after Ctrl-C."""
        flights = dict[str, Trajectory]()
        with Interruption() as interruption:
            for name, law in laws.items():
                try:
                    flights[name] = episodes.fly(law)
                except ValueError as error:  # the system has ended an episode; the results of the training stay
                    bar.write(f"{name} is not judged on the real system: {error}")
                except KeyboardInterrupt:
                    if interruption.at_once:
                        raise
                    whole = f"{len(episodes.paid)} flights, which are paid; judged: {', '.join(flights) or 'nobody'}"
                    bar.write(f"interrupted after {whole}")
                    break
        return flights

    def _written(self, summary: dict[str, Any], judged: Mapping[str, Judged], judging: float) -> dict[str, Any]:
        """Write ``weights.pt`` and ``metrics.json``, whose content is returned."""
        summary["cost_of_learning"] = results.cost_of_learning(self.episodes, self._paid)
        if self.config.reference:
            best, better = exact_optimum(self.unseen, self.make_policy), judged[summary["better"]].control_costs.mean()
            summary["reference"] = {"J_a": best.cost, "J_a_by_gradients": best.by_gradients}
            summary["reference"]["better_over_reference"] = better.item() / best.cost
        total, seconds = time.perf_counter() - self.started, results.seconds_per_step(self.episodes)
        seconds["judge"] = judging
        summary["seconds"] = seconds | {"rest": total - sum(seconds.values()), "total": total}
        metrics = finite({"plant": self.algorithm.twin.plant.name, "episodes": self.episodes, "summary": summary})
        weights = {role: policy.state_dict() for role, policy in self.algorithm.policies.items()}
        # Metrics of an earlier end must not lie beside these weights, because they say that the run is finished.
        (self.folder / "metrics.json").unlink(missing_ok=True)
        twin = self.algorithm.twin
        save_tensors(self.folder / "weights.pt", weights | {"noise": twin.noise} | twin.state_dict())
        write_json(self.folder / "metrics.json", metrics)
        return metrics

    def _drawn(self, flights: Mapping[str, Trajectory], judged: Mapping[str, Judged]) -> dict[str, np.ndarray]:
        """Draw the figures of the training and of the unseen episodes, into ``figures/``; their pixels by name."""
        live, where = self.algorithm.referee.live, "on the twin" if self.unseen.judged_on == "twin" else ""
        shown = {who: flown.each()[0] for who, flown in flights.items() if who == live or who not in ROLES}
        trajectories = {who: until_end(self.unseen.flying, flown) for who, flown in shown.items()}
        snapshot = Snapshot.take(self.algorithm, self.initial_closure, self.episodes)
        drawn = {**figures.figures_of(snapshot), **self.config.plant_figures(snapshot)}
        drawn["flights"] = figures.flights(self.unseen.physics, trajectories, where=where)
        drawn["unseen"] = figures.unseen(judged, where=where)
        images = {name: figures.pixels(figure) for name, figure in drawn.items()}
        (self.folder / "figures").mkdir(exist_ok=True)
        for name, image in images.items():
            figures.save_pixels(image, self.folder / "figures" / f"{name}.png")
        return images
