"""The detections, lists and readings of stills of a flight's ground, noted frame by frame for the metrics.

`Watch` stands between the ground's pipeline and its detector and refiner, passes everything on and remembers the last
answer. Nothing here changes what is shown or sent.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from hvt_common.inference.classify import Classifier
from hvt_common.protocol.messages import RoiHeader, StillResult
from hvt_common.transport.inbox import Received
from hvt_common.values import Boxes, Detections, Image, Posterior, Tracks, View, iou
from hvt_ground.events import Overlay, Refinement
from hvt_ground.perception.pipeline import Pipeline
from hvt_ground.perception.stills.classify import object_crops
from hvt_ground.perception.stills.decode import DecodedStill
from hvt_ground.perception.stills.refine import Refiner
from hvt_study.datasets.labels import NO_ID, inside_frame
from hvt_study.flights.flight_link import Arrival
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.observed import ObservedFrame, Opinion, RefinedObject, StillArrival, score_entropy_nats

_SAME_OBJECT_IOU = 0.4
"""As re-detection asks of a detection at an object's place."""


class Watch:
    """Stands for a pipeline's detector on the base stream and its refiner; stills go to the detector itself."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._detector, self._refiner = pipeline.detector, pipeline.refiner
        self._found: Detections | None = None
        self.class_names = pipeline.detector.class_names
        self.listed: Tracks | None = None
        """The tracks of the last list, before refinement."""
        # Events say neither raw detections nor confidences without refinement.
        pipeline.detector, pipeline.refiner = self, cast("Refiner", self)

    def detect(self, image_bgr: Image) -> Detections | None:
        self._found = self._detector.detect(image_bgr)
        return self._found

    def take_found(self) -> Detections | None:
        """Detections on the base stream since the last time; None where nothing was searched."""
        found, self._found = self._found, None
        return found

    def shown(self, tracks: Tracks, **about: Any) -> Overlay:
        self.listed = tracks
        return self._refiner.shown(tracks, **about)

    def preview(self, tracks: Tracks, **about: Any) -> Overlay:
        self.listed = tracks
        return self._refiner.preview(tracks, **about)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._refiner, name)


@dataclass(frozen=True, slots=True)
class _Pending:
    done: RefinedObject
    frame_index: int
    edge_track_id: int
    box_source_px: Boxes


class FlightRecord:
    """Gathers between two lists; `complete` turns a list into the input of the metrics.

    ``classes`` is how many the detector knows. The ground's ``classifier`` is asked of each still and of the base
    crop at its place; None takes the opinion of re-detection on the still, and that of the list on the object at
    the still's frame.
    """

    def __init__(self, view: View, *, started_ns: int, classes: int, classifier: Classifier | None) -> None:
        self._view = view
        self._started_ns = started_ns
        self._classes = classes
        self._classifier = classifier
        self._headers: dict[int, RoiHeader] = {}
        self._answers: dict[tuple[int, int], Opinion] = {}
        self._stills: list[StillArrival] = []
        self._pending: list[_Pending] = []

    # Arrivals

    def still(self, header: RoiHeader, arrival: Arrival[Received]) -> None:
        self._headers[header.sequence] = header
        self._stills.append(
            StillArrival(
                sequence=header.sequence,
                capture_s=self._seconds(header.capture_ns),
                sent_s=self._seconds(arrival.enter_ns),
                arrived_s=self._seconds(arrival.arrival_ns),
                size_bytes=len(arrival.message.payload),
                line_bytes=arrival.size_bytes,
                reason=header.reason,
            )
        )

    def answers(self, results: Iterable[StillResult]) -> None:
        """The ground has answered the edge with the classes of its stills."""
        for one in results:
            if one.class_name:
                opinion = Opinion(one.class_name, one.confidence, one.entropy_nats)
                self._answers[one.still_sequence, one.track_id] = opinion

    def refinement(self, event: Refinement, *, at_ns: int) -> None:
        """An object in a still has been named, or given up."""
        header = self._headers[event.still_sequence]
        box = np.array([event.box_base_px], np.float32)
        width, height = self._view.base_size
        base, still = self._opinions_on(event, header)
        done = RefinedObject(
            still_sequence=event.still_sequence,
            track_id=NO_ID if event.track_id is None else event.track_id,
            at_s=self._seconds(at_ns),
            name_before=event.class_before,
            name_after=event.class_after,
            area_share=float((box[0, 2:] - box[0, :2]).prod()) / (width * height),
            base=base,
            still=still,
        )
        self._pending.append(
            _Pending(done, header.frame_index, event.edge_track_id, self._view.to_source(box))
        )

    # Lists

    def listed(self, overlay: Overlay, tracks: Tracks) -> ObservedFrame:
        """A list, with the same tracks before refinement; those outside the picture are in ``tracks`` alone."""
        rows = np.flatnonzero(np.isin(tracks.ids, overlay.track_ids))
        assert np.array_equal(overlay.track_ids, tracks.ids[rows]), "both are of the same list"
        return ObservedFrame(
            self._inside(overlay.boxes_base_px),
            overlay.track_ids,
            overlay.classes,
            overlay.confidences,
            overlay.base_classes,
            confidences_before=tracks.confidences[rows].astype(np.float32),
            origins=overlay.origins,
        )

    def detected(self, found: Detections, class_names: tuple[str, ...]) -> FrameView:
        names = tuple(class_names[kind] for kind in found.class_ids.tolist())
        return FrameView.plain(self._inside(found.boxes_xyxy_px), names, found.confidences)

    def complete(
        self,
        seen: ObservedFrame,
        *,
        lists: Mapping[int, ObservedFrame],
        at_ns: int | None = None,
        detections: FrameView | None = None,
    ) -> ObservedFrame:
        """The list with everything that came since the last one was completed; ``lists`` are those before it.

        ``at_ns`` is when somebody can look at it; None: as it was.
        """
        refined = tuple(self._with_opinions(one, lists) for one in self._pending)
        stills = tuple(self._stills)
        self._pending.clear()
        self._stills.clear()
        return replace(
            seen,
            shown_s=seen.shown_s if at_ns is None else self._seconds(at_ns),
            detections=seen.detections if detections is None else detections,
            stills=seen.stills + stills,
            refined=seen.refined + refined,
        )

    def _opinions_on(self, event: Refinement, header: RoiHeader) -> tuple[Opinion | None, Opinion | None]:
        """The classifier's opinions on the base crop and on the still."""
        if self._classifier is None or event.base_crop_bgr is None or event.still_bgr is None:
            return None, None
        boxes = (event.box_base_px,) * (2 if header.also else 1)  # one of several has to be cut out
        crops = [
            object_crops(
                DecodedStill(image, header.crop_source_px, boxes, header.frame_index),
                view=self._view,
            )[0]
            for image in (event.base_crop_bgr, event.still_bgr)
        ]
        base, still = self._classifier.classify(crops)
        return _opinion(base), _opinion(still)

    def _with_opinions(self, one: _Pending, lists: Mapping[int, ObservedFrame]) -> RefinedObject:
        read = self._answers.pop((one.done.still_sequence, one.edge_track_id), None)
        if self._classifier is not None:
            return one.done
        seen = lists.get(one.frame_index)
        base = None if seen is None else self._in_list(seen.base_view(), one.box_source_px)
        return replace(one.done, base=base, still=read)

    def _in_list(self, view: FrameView, box_source_px: Boxes) -> Opinion | None:
        """The opinion of a list at an object's place."""
        if not len(view):
            return None
        overlap = iou(box_source_px, view.boxes_xyxy_px)[0]
        row = int(overlap.argmax())
        if overlap[row] < _SAME_OBJECT_IOU:
            return None
        confidence = float(view.confidences[row])
        return Opinion(view.class_names[row], confidence, score_entropy_nats(confidence, self._classes))

    def _inside(self, boxes_base_px: Boxes) -> Boxes:
        return inside_frame(self._view.to_source(boxes_base_px), self._view.source_size)

    def _seconds(self, at_ns: int) -> float:
        return (at_ns - self._started_ns) / 1e9


def _opinion(posterior: Posterior) -> Opinion:
    return Opinion(posterior.class_name, posterior.confidence, posterior.entropy_nats)
