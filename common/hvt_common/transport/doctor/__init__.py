"""Why a link does not come up, in one sentence."""
