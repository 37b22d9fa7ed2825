"""The parts of a dataset: `Sequence`, `Clip`, `FrameLabels`, `ClassMap`, `reference_labels`; `layouts` opens them."""
