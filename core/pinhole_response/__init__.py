"""The depth-dependent pinhole response: the blur of the whole hole, without rays. The derivation: docs/pinhole-response.md.

Entry points: `pinhole_operator.PinholeOperator` is the linear map from a volume to the images of all views, with its
adjoint and gradients; `pinhole_views.PinholeViews` chooses the zones of depth of a view and their lattices.

A zone goes through four modules: `depth_zone` has its geometry, `zone_response` makes its response (a `DepthResponse`) from
that, `compiled` or `reference` work with the response, and `zone_gradient` takes their gradients back to the view's numbers.
The kernels come from `pixel_kernels`, or from `oblique_kernels` where they depend on the photons' direction.

To add an effect of the photons' direction, add its numbers to `DirectionalEffects` and its factor to `ObliqueSpectra`. To
add other code that works with a response, write a module of the functions of `reference` and choose it in `depth_backend`.
"""
