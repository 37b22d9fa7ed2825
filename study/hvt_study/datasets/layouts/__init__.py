"""One module a layout of datasets (VisDrone, UAVDT, MOT, clips, pictures, the demo): from URI to `Sequence`."""
