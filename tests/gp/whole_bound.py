"""The collapsed bound in one piece, differentiable by all of its tensors, for a comparison with that in blocks."""

from gpmpc.gp._sparse import JITTER, _block_sums, _bound, inducing_factor


def collapsed_bound(inducing, features, targets, hyperparameters, method="sgpr", jitter=JITTER):
    Lz = inducing_factor(inducing, hyperparameters, jitter)
    sums = _block_sums(Lz, inducing, features, targets, hyperparameters, method)
    return _bound(sums, len(features), hyperparameters, method)
