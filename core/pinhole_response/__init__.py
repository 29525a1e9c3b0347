"""The depth-dependent pinhole response: the blur of the whole hole, without rays. The derivation: docs/pinhole-response.md.

Entry points: `pinhole_operator.PinholeOperator` is the linear map from a volume to the images of all views, with its
adjoint and gradients; `depth_zone.DepthZone` has the geometry of one view and one range of depths, from which
`zone_response` makes the numbers that the work is done with (`depth_response.DepthResponse`).
"""
