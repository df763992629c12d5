"""Why an answer must not be relied on as it is."""

from collections.abc import Sequence

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.structure_sigma import uncertain_structures
from softtissue_estimator.ros.frames import Answer
from softtissue_estimator.support.sentences import LONGEST, one_sentence


def degradation_reasons(answer: Answer, total_s: float, config: EstimatorConfig) -> list[str]:
    """List why an answer is degraded that came `total_s` seconds after its cloud, what weighs most first."""
    reasons = list(answer.estimate.diagnosis.doubts)
    if answer.pose.doubt:
        reasons.append(answer.pose.doubt)
    uncertain = uncertain_structures(answer.organ, answer.structure_sigma, config.maximum_sigma_m)
    if uncertain is not None:
        reasons.append(uncertain)
    if answer.visible_fraction < config.minimum_visible_fraction:
        reasons.append(
            f"visible share of the surface: expected at least {100 * config.minimum_visible_fraction:.3g} %,"
            f" got {100 * answer.visible_fraction:.3g} %"
        )
    if answer.rejected_fraction > config.maximum_rejected_fraction:
        reasons.append(
            f"rejected correspondences: expected at most {100 * config.maximum_rejected_fraction:.3g} %,"
            f" got {100 * answer.rejected_fraction:.3g} %"
        )
    if total_s > config.frame_budget_s:
        reasons.append(
            f"time from cloud to answer: expected at most {1e3 * config.frame_budget_s:.3g} ms,"
            f" got {1e3 * total_s:.3g} ms"
        )
    return reasons


def in_one_sentence(reasons: Sequence[str]) -> str:
    """Join as many whole reasons as a sentence holds, and count the others; empty where there are none."""
    for count in range(len(reasons), 1, -1):
        more = f"; and {len(reasons) - count} more" if count < len(reasons) else ""
        joined = "; ".join(one_sentence(reason) for reason in reasons[:count]) + more
        if len(joined) <= LONGEST:
            return joined
    more = f"; and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    return one_sentence(reasons[0], LONGEST - len(more)) + more if reasons else ""
