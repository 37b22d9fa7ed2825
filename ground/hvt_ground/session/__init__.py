"""One edge's flight: subscriptions, its receiver, its receiver reports, its sessions."""
