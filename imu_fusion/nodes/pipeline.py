"""A recording through real ROS 2 nodes, smoothed and recorded: one call.

    replayer -> smoother and other estimators -> recorder; smoothing_trigger calls smoother/smooth

Each node is a process of an own ROS domain. The estimates are those of ``batch.process``.
"""

from pathlib import Path

from imu_fusion.errors import TopicError
from imu_fusion.nodes.processes import Graph
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.inputs import find_inputs
from imu_fusion.recordings.results import write_results
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.smoother import RESULTS_TOPIC, results_value

SMOOTHER = "smoother"
_PATIENCE = 3600.0  # s; the nodes notice by themselves when nothing can come any more


def run(bag, out, params_file=None, without=(), remap=None, overwrite=False, logs=None,
        show=True):
    """Replay a recording through the estimators into a new recording.

    Args:
        bag: recording with what the smoother needs.
        out: rosbag2 directory to write: the recording, with old estimates left out, and the
            new ones; results.json beside them as of ``batch.process``.
        params_file: ROS 2 parameter file for all nodes, or None for defaults.
        without: node names of estimators to leave out.
        remap: dict of topic names of ours to those in the recording.
        overwrite: replace ``out``.
        logs: directory for what the nodes print; a temporary one if None.
        show: let replayer and smoothing trigger print here.

    Returns:
        ROS domain id that was used.

    Raises:
        ImuFusionError: recording, parameters or topics are not usable, or a node failed.
    """
    for name in without:
        if name not in STAGES or name == SMOOTHER:
            raise TopicError(f"no estimator '{name}' to leave out; there are: "
                             + ", ".join(set(STAGES) - {SMOOTHER}))
    renamed, estimators, made = {}, [], set()
    with open_bag(bag) as reader:
        for stage in STAGES.values():
            # Here, for a bad file to be refused before anything starts.
            stage, _ = stage.prepare(params_file)
            if stage.node in without or stage.unusable:
                continue
            names, missing = find_inputs(reader, *stage.input_types(), remap or {})
            if missing and stage.node != SMOOTHER:
                continue
            if missing:
                raise TopicError(f"nothing to smooth: {missing}")
            estimators.append(stage.node)
            made |= stage.outputs.keys()
            renamed |= {name: topic for topic, name in names.items()
                        if name.lstrip("/") != topic}
        old = tuple(name for name in reader.topics if name.lstrip("/") in made)
    common = {"params_file": params_file and Path(params_file).absolute()}
    with Graph(logs) as graph:
        graph.start("recorder", **common, out=str(Path(out).absolute()), overwrite=overwrite,
                    end_with_sources=True, expected_sources=(SMOOTHER,))
        for node in estimators:
            graph.start(node, **common, qos="reliable")
        graph.start("smoothing_trigger", show=show, **common)
        graph.start("replayer", show=show, **common, bag=str(Path(bag).absolute()), rate=0.0,
                    exclude=old,
                    remap=tuple(f"{name}:=/{topic}" for name, topic in renamed.items()),
                    wait_for_subscribers=0, wait_for_nodes=("recorder", "smoothing_trigger", *estimators))
        graph.wait("replayer", _PATIENCE)
        graph.wait("smoothing_trigger", _PATIENCE)
        # Rarely the recorder does not notice the end of the smoother's session (why is not
        # understood): then its file has stopped growing.
        graph.finish("recorder", 15.0, lambda: sum(
            file.stat().st_size for file in Path(out).glob("*.mcap")))
        domain = graph.domain
    with open_bag(out) as reader:
        found = [results_value(cdr) for _, _, _, cdr in reader.messages([f"/{RESULTS_TOPIC}"])]
    write_results(out, {SMOOTHER: found[-1]} if found else {})
    return domain
