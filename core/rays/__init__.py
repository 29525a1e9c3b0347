"""Ray tracing: line integrals of a volume along rays, their exact adjoint and their gradients, on several threads.

Entry points: `tracing.trace_rays` and `tracing.trace_fans` integrate along rays given by their ends or as fans;
`linear_operator.LinearOperator` is the base class of all operators ``A(x)`` with an adjoint ``A.T(y)``;
`execution.Execution` runs the rays of many images (`bundles.Bundles`) on a backend.

A ray goes through four modules: `ray_geometry` describes it in world mm and in index space, `lattices` crops the volume
to its filled part, `bundles` cuts images into parts, and `execution` gives each part to one of the `backends`.

To add a backend, write a module of four functions in `backends` and a row of its table (`backends.BACKENDS`), with what
must be installed (`_PACKAGES`) and whether "auto" takes it (`_AUTOMATIC`); settings, menus and help follow. A backend
that cannot do the depth-dependent response is named in `core/runs/reconstructing.py`.
"""
