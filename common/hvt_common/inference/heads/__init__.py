"""Heads read the outputs of detector networks: others use `choose`, `contract`; the extra `hvt_models` has most.

`choose` holds a network's answers to a few pictures, and the marks of a head and of the embedded detector's in
it, `contract` how its numbers become boxes.
"""

HEAD_NAMES = (
    *("yolox", "yolox-decoded", "yolov5", "yolov6", "yolov8", "yolov8-rows", "end-to-end", "yolov7-rows"),
    *(
        "yolo-nas",
        "nas-rows",
        "nms-lists",
        "rt-detr",
        "rt-detr-rows",
        "rf-detr",
        "labels-boxes-scores",
        "ssd",
    ),
    *("atss", "tf-lists"),
)
"""The values of ``--head``; all but the first are of the model library, and ``--help`` is not to load it."""
