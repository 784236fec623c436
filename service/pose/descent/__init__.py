"""First-order photometric descent, hypotheses and losses, as the published methods use them."""
