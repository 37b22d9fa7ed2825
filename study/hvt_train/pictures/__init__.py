"""Makes the drawn pictures and crops that the models are trained on."""
