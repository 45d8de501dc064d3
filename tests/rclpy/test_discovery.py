"""Discovery where everything starts at the same moment."""

import pytest

from conftest import Harness

LEASE = 50.0  # seconds after which RustDDS wants its participants to be forgotten
STARTS = 4  # nodes that don't take turns are seen whole in half of the starts

PARAMETERS = {
    f"{verb}_{what}"
    for verb, what in (
        ("describe", "parameters"),
        ("get", "parameters"),
        ("get", "parameter_types"),
        ("list", "parameters"),
        ("set", "parameters"),
        ("set", "parameters_atomically"),
    )
}
LIFECYCLE = {
    "change_state",
    "get_available_states",
    "get_available_transitions",
    "get_state",
    "get_transition_graph",
}
EVERY_NODE = {"/diagnostics", "/parameter_events", "/rosout"}
PUBLISHED = {
    "capture_node": {"/pieces/forgotten", "/pieces/image"},
    "feature_node": {"/pieces/features", "/pieces/forgotten", "/pieces/overlay"},
    "solver_node": {"/assembly", "/assembly/image", "/assembly/markers", "/tf_static"},
}
HEARD = {
    "capture_node": {"/image", "/image/compressed", "/pieces/reset"},
    "feature_node": {"/pieces/forgotten", "/pieces/image", "/pieces/reset"},
    "solver_node": {"/pieces/features", "/pieces/forgotten"},
}
SERVED = {"capture_node": {"/capture"}, "feature_node": set(), "solver_node": {"/reset", "/solve"}}


def missing(node, name):
    """What this node does not see of the named one; everything where it does not know it."""
    known = {seen for seen, _ in node.get_node_names_and_namespaces()}
    if name not in known:
        return {name}

    def names(found):
        return {topic for topic, _ in found}

    private = {f"/{name}/{service}" for service in PARAMETERS | LIFECYCLE}
    return (
        (
            (EVERY_NODE | PUBLISHED[name] | {f"/{name}/transition_event"})
            - names(node.get_publisher_names_and_types_by_node(name, "/"))
        )
        | ((HEARD[name] | {"/clock"}) - names(node.get_subscriber_names_and_types_by_node(name, "/")))
        | ((SERVED[name] | private) - names(node.get_service_names_and_types_by_node(name, "/")))
    )


def test_a_node_that_has_ended_is_forgotten_at_once(launcher, ros):
    """Not only when its lease is over, after 50 s; so that nobody calls a service that is not there any more."""
    node = ros.node("looker")
    solver = launcher.start("solver_node")
    ros.until(lambda: not missing(node, "solver_node"), "solver node")
    assert solver.stop() == 0, solver.text()
    ros.until(lambda: not node.get_publishers_info_by_topic("/assembly"), "end of the publisher", LEASE / 2)
    assert "solver_node" not in node.get_node_names()


@pytest.mark.parametrize("start", range(STARTS))
def test_all_that_starts_together_is_seen(launcher, domain, start):
    launcher.cell()
    harness = Harness(domain)
    try:
        node = harness.node("looker")
        seen = harness.until(lambda: not any(missing(node, name) for name in PUBLISHED), "whole graph", required=False)
        assert seen, {name: sorted(missing(node, name)) for name in PUBLISHED}
    finally:
        harness.close()
