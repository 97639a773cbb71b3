"""Measurements of a study: gains of its arms, and its protocol."""

from evaluator.quantity import new_quantity

# ruff: noqa: E501  # one line for each definition

STUDY_GAIN = new_quantity(
    "study.gain_pp.{against}.{task}.{policy}",
    "pp",
    "higher",
    "success in the study arm with less that in the arm {against} over the same starts, in percentage points, "
    "whatever was not executed counted as a failure: {words}",
)
STUDY_GAIN_POOLED = new_quantity(
    "study.gain_pp.{against}.{policy}",
    "pp",
    "higher",
    "the same over the starts of {count} tasks: {words}",
)
STUDY_P = new_quantity(
    "study.mcnemar_p_mid.{against}.{policy}",
    "1",
    "none",
    "two-sided McNemar test of the arm with against {against}, mid-p, over the starts of {count} tasks that differ: {words}",
)
STUDY_GAIN_EXECUTED = new_quantity(
    "study.executed_gain_pp.{against}.{task}.{policy}",
    "pp",
    "higher",
    "per protocol: the gain over the starts that were executed in both arms alone: {words}",
)
STUDY_P_EXECUTED = new_quantity(
    "study.executed_mcnemar_p_mid.{against}.{policy}",
    "1",
    "none",
    "per protocol: the same test over the starts of {count} tasks that were executed in both arms: {words}",
)
STUDY_NOT_EXECUTED = new_quantity(
    "study.not_executed.{arm}.{task}.{policy}",
    "1",
    "lower",
    "share of starts on which the arm {arm} executed nothing: {words}",
)
PROTOCOL_DEPARTURES = new_quantity(
    "protocol.departures",
    "count",
    "lower",
    "departures of what was done from the protocol that was locked before the first trial",
)
PROTOCOL_DIFFERENCE = new_quantity(
    "protocol.primary.difference_pp",
    "pp",
    "higher",
    "the primary question of the protocol, over starts tried in both arms: {about}",
)
PROTOCOL_DIFFERENCE_P = new_quantity(
    "protocol.primary.difference_p",
    "1",
    "none",
    "two-sided McNemar test with mid-p of the primary question, at {alpha:g}: {about}",
)
PROTOCOL_AGREEMENT = new_quantity(
    "protocol.primary.agreement",
    "1",
    "higher",
    "the primary question of the protocol, agreed / decided trials: {about}",
)
PROTOCOL_AGREEMENT_P = new_quantity(
    "protocol.primary.agreement_p",
    "1",
    "none",
    "two-sided score test of the primary question, at {alpha:g}, 1 below the limit: {about}",
)
