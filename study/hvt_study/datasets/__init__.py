"""What a dataset is: `Sequence`, `Clip`, `FrameLabels`, `ClassMap`, `reference_labels`; `layouts` opens them."""
