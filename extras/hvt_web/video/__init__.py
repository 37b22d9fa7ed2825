"""The live picture as browsers take it: `pictures` codes it again where need be, `fmp4` wraps it."""
