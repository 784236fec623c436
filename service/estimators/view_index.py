"""The default estimator: recognise the photo among rendered views, resect, align. Needs no prior.

    features of the photo -> views that they vote for -> matches, lifted to 3D -> PnP
    -> while few agree: render there, match again, solve decoupled
    -> align photometrically on a small render, then on larger ones
    -> verification gate -> does the mirror image fit better? Do many matches agree elsewhere, and is that as good?

At first the photo is looked at in a small size. Only if the gate doesn't accept the answer the dearer searches are
tried: in its full size, turned as its corners tell; larger still, with further views; then poses sampled near views.
From a prior pose alignment is tried at once; where that fails it is one more candidate view. What a search does is in
`service/pose/matching/search_stages.py`. Sizes and rounds are the research's; numbers that were measured stand beside
the constants.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from service.errors import InvalidOptions
from service.interfaces import Tools
from service.pose.absolute_pose.pnp import AbsolutePose
from service.pose.descent.hypotheses import poses_near_views
from service.pose.features.image_sizes import PHOTO_PX, sized
from service.pose.features.views import images_of, known_at, photo_at, rendered_frame, rendered_view
from service.pose.matching.correspondences import MATCH_ERROR_PX
from service.pose.matching.render_and_match import render_and_match
from service.pose.matching.search_stages import GOOD_MATCH, aligned, match_record, matched, refined, rematched, resected
from service.pose.retrieval.image_variant import (
    GLANCE_PX,
    GLIMPSE_SHARE,
    SECOND_LOOK,
    Sight,
    first_sight,
    turned_sight,
)
from service.pose.retrieval.index import ViewIndex, prepared_index
from service.pose.retrieval.scores import top
from service.pose.verification.ambiguity import apart, ranked, rivals, whole
from service.pose.verification.appearance import appearance
from service.pose.verification.gate import UNCERTAIN, glance, verify
from service.pose.verification.mirror_images import BEYOND_DOUBT, OUT_OF_REACH, mirrored, unlikeness
from service.results import Candidates, IterationRecord, Reason, Status
from service.types import Camera, Query

GLIMPSES = 2
"""Views that the small photo is matched with."""
WORTH, WORTH_SHARE = 12, 0.055
"""Inliers, and their share of the matches, from which on it is worth to render there: of 168 searches with fewer, 119
of them for photos of other scenes, none led anywhere; with 12 to 30 those have a median share of 0.04 to 0.05."""
STRONG = 80
"""Inliers with which alignment needs no further match."""
FURTHER = 16
"""One view in so many is tried before the search is given up: in a building the likeliest five may all be wrong."""
SAMPLE_PX, SAMPLES, SAMPLE_ROUNDS = 256, 8, 4
MOST_ROUNDS = 100
"""Of an exhaustive search without a budget."""
PROMISING = 12
"""Inliers of a sampled pose with which it is worth a larger render."""
OUT_OF_QUESTION = 3.0
"""Times the answer's mean residual, after one alignment: no such rival is an answer, or nearly as good as one."""
MISFIT = 0.1
"""Mean residual (0..1) of an alignment that led nowhere; right ones have 0.005 to 0.06."""
UNMENDABLE = (Reason.FOCAL_UNCERTAIN, Reason.PLACE_UNCERTAIN, Reason.INTRINSICS_CONTRADICTED)
"""Doubts about a pose at which photo and render agree: no other search knows better."""


@dataclass(frozen=True, slots=True)
class Options:
    candidates: int = 5
    """Index views that the photo is matched with in the first search, 1 to 64; in the second as many others, or a
    sixteenth of all."""
    effort: Literal["fast", "normal", "exhaustive"] = "normal"
    """How hard to search for a photo that the verification gate doesn't accept. `fast`: in the index, and
    with the photo turned. `normal`: then among sampled poses, if something in the photo was recognised.
    `exhaustive`: among sampled poses until the budget ends."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "use_attribute_docstrings": True}

    def __post_init__(self) -> None:
        if not 1 <= self.candidates <= 64:
            raise InvalidOptions(f"must lie in 1..64, is {self.candidates}.", where="candidates")
        if self.effort not in ("fast", "normal", "exhaustive"):
            raise InvalidOptions(f"must be fast, normal or exhaustive, is '{self.effort}'.", where="effort")


def prepare(tools: Tools, cache_dir: Path | None) -> ViewIndex:
    """Make or read the scene's view index: a second or two, once."""
    return prepared_index(tools, cache_dir)


def run(query: Query, tools: Tools, options: Options) -> Iterator[IterationRecord]:
    """Search until the gate accepts an answer; see the module's picture."""
    hunt = _Hunt(query, tools, Sight(GLANCE_PX))
    if query.prior:
        yield from hunt.follow(_from_prior(query, tools), hunt.sight, expected=True)
        if hunt.accepted:
            if query.region is None:  # a guess doesn't decide between places that look alike
                yield from hunt.contest()
            return
    for search, sight in _searches(query, tools, options, hunt):
        yield from hunt.follow(search, sight)
        if hunt.accepted:
            break
    if hunt.score >= UNCERTAIN:
        yield from hunt.reflect()
    if hunt.accepted and not hunt.mirrored:
        yield from hunt.contest()


@dataclass(slots=True)
class _Hunt:
    """What the searches have led to."""

    query: Query
    tools: Tools
    sight: Sight
    """How the photo was looked at when the answer was found."""
    answer: IterationRecord | None = None
    """The one that the gate likes best."""
    score: float = 0.0
    accepted: bool = False
    glimpsing: bool = False
    """A doubt that is left after a first glimpse is no reason to stop."""
    mirrored: bool = False
    """Whether the photo's mirror image fits better."""
    recognised: bool = False
    """Whether a render at some pose had more matches with the photo than chance gives: foreign photos never do."""

    def follow(
        self, search: Iterator[IterationRecord], sight: Sight, expected: bool = False
    ) -> Iterator[IterationRecord]:
        """Yield a search's records, with the best answer so far, and put its end before the gate.

        An answer that was expected, or that many matches with a view led to, needs no more of them if the pixels are
        clear; but a free lens makes pixels agree where the pose is wrong.
        """
        last: IterationRecord | None = None
        for last in search:
            self.recognised |= last.stage == "rematch"
            yield self._with_answer(last)
        if last is None or last.stage != "refine":
            return  # the search gave up
        known = self.query.corrected(last.lens)
        agreeing = last.num_inliers or 0
        enough = expected or (agreeing >= GOOD_MATCH and not known.focal_sigma)
        seen = glance(known, last.pose, self.tools, agreeing) if enough else None
        verdict = seen or verify(known, last.pose, self.tools)
        if self.answer is None or verdict.score > self.score:
            self.answer, self.score, self.sight = last, verdict.score, sight
        unmendable = verdict.reason in UNMENDABLE and not self.glimpsing
        self.accepted = verdict.status is Status.LOCALIZED or unmendable
        yield self._with_answer(
            IterationRecord("verify", last.pose, loss=1.0 - self.score, num_inliers=verdict.inliers)
        )

    def reflect(self) -> Iterator[IterationRecord]:
        """Where the scene is much like its mirror image, look whether the photo's mirror image fits better.

        What doesn't fit well as it is has to fit well beyond doubt in the mirror.
        """
        assert self.answer is not None
        if not self.tools.prepared.like_its_mirror_image:
            return
        known = self.query.corrected(self.answer.lens)
        own = verify(known, self.answer.pose, self.tools).signals
        if own["gradients"] > BEYOND_DOUBT:
            return
        query = replace(mirrored(known), prior=None, region=None)  # those are of the photo as it was sent
        tools = replace(self.tools, memo={})
        worst, last = OUT_OF_REACH * (self.answer.loss or np.inf), None
        for last in _reflected(replace(self.sight, eighths=-self.sight.eighths % 8), query, tools, worst):
            yield self._with_answer(replace(last, stage="check_mirror", matches=None))
        if last is None or last.stage != "refine":
            return
        known = query.corrected(last.lens)
        if not self.accepted and verify(known, last.pose, tools).status is not Status.LOCALIZED:
            return
        frame, camera = rendered_frame(last.pose, known, tools)
        size = camera.intrinsics
        there = appearance(photo_at(query, tools, size), frame, known_at(query, tools, size))
        self.mirrored = unlikeness(there) < unlikeness(own)
        yield replace(self.answer, stage="check_mirror", mirrored=self.mirrored)

    def contest(self) -> Iterator[IterationRecord]:
        """Look for other answers that the gate accepts; the best becomes the answer, and the last record has all.

        A pose that explains the whole photo has none in a scene whose views are all different.
        """
        assert self.answer is not None
        answers = [self.answer]
        known = self.query.corrected(self.answer.lens)
        signals = verify(known, self.answer.pose, self.tools).signals
        if whole(signals) and not self.tools.prepared.repeats_itself:
            return
        frame, _ = rendered_frame(self.answer.pose, known, self.tools)
        distance = float(np.median(frame.median_depth[frame.alpha > 0.5]))
        pixels = self.sight.max_error_px * self.query.intrinsics.long_side / PHOTO_PX
        judged = (self.answer.pose, distance, signals)
        suspected = rivals(
            self.sight.features(self.query, self.tools), known.intrinsics, *judged,
            self.tools.prepared.views, self.sight.votes(self.query, self.tools), self.tools.matcher, pixels,
        )  # fmt: skip
        for rival in suspected:
            rival, last = replace(rival, correction=self.answer.lens), None
            first = next(aligned(rival, self.query, self.tools), None)
            if first is None or (first.loss or 0.0) > OUT_OF_QUESTION * (self.answer.loss or np.inf):
                continue
            for last in refined(rival, self.query, self.tools):
                yield self._with_answer(last)
            if last is None or last.stage != "refine" or not all(apart(last.pose, a.pose, distance) for a in answers):
                continue
            verdict = verify(self.query.corrected(last.lens), last.pose, self.tools)
            if verdict.status is Status.LOCALIZED:
                answers.append(last)
        if len(answers) > 1:
            self.answer, others = ranked(answers)
            yield replace(self.answer, stage="check_ambiguity", rivals=others)

    def _with_answer(self, record: IterationRecord) -> IterationRecord:
        return replace(record, pose=self.answer.pose, lens=self.answer.lens) if self.answer else record


def _searches(
    query: Query, tools: Tools, options: Options, hunt: _Hunt
) -> Iterator[tuple[Iterator[IterationRecord], Sight]]:
    """The ways to look for the photo, cheapest first; with each how it looks."""
    sight = first_sight(query, tools)
    stage = "retrieve"
    if not query.focal_sigma:  # a free lens asks for many matches
        glimpse = sight.sized(GLIMPSE_SHARE)
        likeliest = top(glimpse.votes(query, tools), min(GLIMPSES, options.candidates))
        hunt.glimpsing = True
        yield _search(stage, glimpse, deque(likeliest), query, tools), glimpse
        hunt.glimpsing = False
        stage = "retrieve_full_size"
    sight = turned_sight(sight, query, tools)
    likeliest = top(sight.votes(query, tools), options.candidates)
    yield _search("retrieve_rotated" if sight.eighths else stage, sight, deque(likeliest), query, tools), sight
    sight = sight.sized(SECOND_LOOK)
    votes = sight.votes(query, tools)
    untried = deque(top(votes, len(votes))[options.candidates :][: max(options.candidates, len(votes) // FURTHER)])
    while untried:
        yield _search("retrieve_more_views", sight, untried, query, tools), sight
    if options.effort == "fast" or (options.effort == "normal" and not hunt.recognised):
        return
    for _ in range(SAMPLE_ROUNDS if options.effort == "normal" else MOST_ROUNDS):
        yield _sampled(sight, query, tools), sight


def _from_prior(query: Query, tools: Tools) -> Iterator[IterationRecord]:
    """Align from the prior pose, which may be some ten degrees off; end early where nothing fits."""
    assert query.prior is not None
    for record in aligned(AbsolutePose(query.prior, np.zeros(0, bool)), query, tools):
        if (record.loss or 0.0) > MISFIT:
            return
        yield replace(record, num_inliers=None)


def _search(
    stage: str,
    sight: Sight,
    untried: deque[int],
    query: Query,
    tools: Tools,
) -> Iterator[IterationRecord]:
    """Go from views, the likeliest first, to an aligned pose; end early where too few matches agree.

    The views that were looked at are taken from `untried`.
    """
    index: ViewIndex = tools.prepared
    poses = [index.views[i].camera.pose for i in untried]
    scores = sight.votes(query, tools)[list(untried)]
    candidates = Candidates(np.stack([pose.world_from_camera for pose in poses]), scores)
    yield IterationRecord(stage, query.prior or poses[0], candidates=candidates)
    views = (index.views[untried.popleft()] for _ in range(len(untried)))
    if query.prior and stage == "retrieve":
        views = chain([rendered_view(query.prior, query, tools)[0]], views)
    found = yield from matched(sight, views, query, tools)
    if found and found.num_inliers < max(WORTH, WORTH_SHARE * len(found.inlier)):
        return
    if found and found.num_inliers < STRONG:
        found = yield from rematched(found, query, tools)
    unsettled = (yield from aligned(found, query, tools)) if found else None
    if unsettled:
        yield from refined(unsettled, query, tools)


def _reflected(sight: Sight, query: Query, tools: Tools, worst: float) -> Iterator[IterationRecord]:
    """Match a mirrored photo and align it; end early where the first alignment's residual is worse than this."""
    views = (tools.prepared.views[i] for i in top(sight.votes(query, tools), GLIMPSES))
    found = yield from matched(sight, views, query, tools)
    if found is None or found.num_inliers < WORTH:
        return
    for record in aligned(found, query, tools):
        if (record.loss or 0.0) > worst:
            return
        yield record


def _sampled(sight: Sight, query: Query, tools: Tools) -> Iterator[IterationRecord]:
    """Render at sampled poses and match; go on from the one that most matches agree with."""
    index: ViewIndex = tools.prepared
    votes = sight.votes(query, tools)
    poses = poses_near_views(index.views, votes, -0.25 * np.pi * sight.eighths, SAMPLES, tools.rng)
    lens = sized(query.intrinsics, SAMPLE_PX)
    best: AbsolutePose | None = None
    for pose in poses:
        matches, view = render_and_match(Camera(lens, pose), tools.rasterizer, images_of(query, tools), None)
        found = resected(matches, query, MATCH_ERROR_PX * PHOTO_PX / SAMPLE_PX, 500)
        if found and (best is None or found.num_inliers > best.num_inliers):
            best = found
        yield match_record("sample_poses", best or pose, matches, found, view.camera)
    if best and best.num_inliers >= PROMISING:
        yield from refined(best, query, tools)
