"""The default estimator's tuning: the search's own values, and those of its steps."""

from __future__ import annotations

from dataclasses import dataclass

from service.pose.matching.match_stages import MATCHING, MatchingConfig
from service.pose.refinement.refine_stage import REFINE_STAGE, RefineStageConfig
from service.pose.refinement.refinement_config import OTHER_LIGHT, RefinementConfig
from service.pose.retrieval.ambiguous_hypotheses import AMBIGUITY, AmbiguityConfig
from service.pose.retrieval.image_variant import RETRIEVAL, RetrievalConfig
from service.pose.training_photos.patch_pose import PATCH_POSE, PatchPoseConfig
from service.pose.verification.ambiguity import ANSWERS, AnswerConfig
from service.pose.verification.gate import VERIFICATION, VerificationConfig
from service.pose.verification.mirror_images import MIRROR, MirrorConfig
from service.results import Reason


@dataclass(frozen=True, slots=True)
class SearchConfig:
    """The default estimator's tuning: the search's own values, and those of its steps."""

    retrieval: RetrievalConfig = RETRIEVAL
    matching: MatchingConfig = MATCHING
    refinement: RefineStageConfig = REFINE_STAGE
    verification: VerificationConfig = VERIFICATION
    ambiguity: AmbiguityConfig = AMBIGUITY
    answers: AnswerConfig = ANSWERS
    mirror: MirrorConfig = MIRROR
    patches: PatchPoseConfig = PATCH_POSE
    small_photo_factor: float = 0.77
    """Size of the photo in the stage `retrieve`, relative to `retrieve_full_size`: a whole, sharp photo is found in
    half the time. Each of the 58 clean test photos has 75 or more matches that agree with its likeliest view, foreign
    ones 12."""
    small_photo_views: int = 2
    """Views that the small photo is matched with."""
    large_photo_factor: float = 1.25
    """Size of the photo in the stage `retrieve_more_views`, relative to `retrieve_full_size`."""
    further_views_divisor: int = 16
    max_further_views: int = 64
    """One view in so many, but not more than this, is matched before the search is given up: in a building the
    likeliest five may be wrong."""
    free_views: int = 8
    """Views beside the index that a photo is matched with which no view of the index led to; 0: none."""
    rematch_below_inliers: int = 30
    """With fewer inliers a pose is matched with a render before it is refined..."""
    rematch_if_refused_below_inliers: int = 80
    """...and with fewer than that if the gate refuses what refinement led to: a render and its features cost as much as
    refinement, which mostly converges without."""
    photometric_min_inliers: float = MATCHING.sufficient_inliers
    """Inliers with a view from which on the pixels alone may decide the verification..."""
    photometric_min_inliers_free_lens: int = 100
    """...and with estimated intrinsics, with which pixels agree more easily."""
    other_light: RefinementConfig = OTHER_LIGHT
    """Of the refinement of a refused pose, in case the photo is in other light than the scene..."""
    min_gradients_other_light: float = 0.75
    """...where the gradients of the better half correlate by this much: 0.8 and more at 11 right poses of photos at
    night that were refused, 0.5 and less at most poses in other places."""
    max_prior_loss: float = 0.1
    """Mean residual (0..1) of a refinement from a prior pose that led nowhere; right ones have 0.005 to 0.06."""
    sample_render_px: int = 256
    samples: int = 8
    """Renders at sampled poses in a round: long side, and how many."""
    sample_rounds: int = 4
    max_sample_rounds: int = 100
    """Rounds with effort `normal`, and with `exhaustive` if there is no budget."""
    min_sample_inliers: int = 12
    """Inliers of a sampled pose from which on it is rendered in full size."""
    max_plain_distortion: float = 0.09
    """Estimated distortion k1 r^2, at the image's corner, beyond which the lens is checked though the answer was
    accepted: a phone's is 0.05, that of an equidistant fisheye of 90 degrees 0.3."""
    min_plain_inlier_share: float = 0.65
    """Share of the matches that agree with an accepted answer with an estimated lens, below which that is checked, too:
    photos of the test scenes have 0.71 and more, lenses beyond SIMPLE_RADIAL 0.62."""
    min_lens_matches: int = 80
    """Matches with a render at the answer with which lens models are fitted."""
    fisheye_doubts: tuple[Reason, ...] = (Reason.FOCAL_UNCERTAIN, Reason.POSITION_UNCERTAIN, Reason.OUTSIDE_PRIOR)
    """Doubts that don't speak against a fisheye's answer."""
    index_wait_s: float = 0.5
    """While the index is built: the time between two records of a job that waits for the whole of it."""
    ambiguity_photo_px: int = 256
    """Long side of the photo in which other poses are looked for where a prior pose led to the answer."""
    min_repeated_colour: float = 0.9
    min_colour_edges: float = 0.72
    """Local colour correlation, or correlation of the edges in colour, of which a pose that only colours speak against
    needs one to be compared with its rivals and taken for the end of the search: poses that are off by one thing of a
    row have 0.89 and 0.66 at most, right ones in a scene by another trainer 0.55 to 0.95 and 0.78 to 0.90."""
    sure_local_colour: float = 0.97
    least_colour_edges: float = 0.6
    """Local colour correlation below which an accepted pose in a scene that repeats itself needs edges in colour that
    correlate by this much: grey things of a row have 0.96 and 0.5, where the thing itself is missing; of 230 right
    poses none is below both."""
    max_rival_ratio: float = 0.9
    """Dissimilarity of photo and render at a pose that only colours speak against, relative to that at its mirror image
    and at places that look like it: with less it is accepted. Of photos of a scene by another trainer right poses have
    0.45 to 0.86, their mirror images 1.16 and more."""
    rival_views: int = 5
    min_mirror_inliers: int = 30
    """Views that a render's mirror image is matched with to find its place, and inliers from which on that is a rival:
    a mirrored photo whose wrong pose a hundred matches support has more at the right one."""
    min_rival_gradients: float = 0.8
    """Correlation of the gradients of the better half from which on another pose is a rival: less shows something
    else."""
    max_ambiguous_loss_ratio: float = 3.0
    """Times the answer's mean residual, after one refinement: beyond it an ambiguous hypothesis is none."""


SEARCH = SearchConfig()
