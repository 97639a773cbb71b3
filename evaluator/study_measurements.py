"""Measurements of a study: what is compared, and its protocol."""

from evaluator.quantity import new_quantity

# ruff: noqa: E501  # one line for each definition

COMPARED = new_quantity(
    "comparison.pp.{second}.against.{first}",
    "pp",
    "higher",
    "recorded success of {second} less that of {first}, over all tasks, each weighted by its pairs: {words}",
)
COMPARED_IN_TASK = new_quantity(
    "comparison.pp.{second}.against.{first}.{task}",
    "pp",
    "higher",
    "the same in {task}: {words}",
)
PROTOCOL_DEPARTURES = new_quantity(
    "protocol.departures",
    "count",
    "lower",
    "departures of what was done from the protocol that was locked before the first trial",
)
