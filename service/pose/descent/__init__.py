"""First-order pose optimization, as the published baselines use it: losses, Adam, parametrizations, hypotheses.

`gradient_descent` moves poses along the renderer's gradient of one of the `losses`; `decoupled_gradient` along those of
losses on match vectors; `hypotheses` samples poses; `contribution_pruning` makes the smaller scene they are rendered
with.
"""
