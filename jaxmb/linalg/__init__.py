"""Linear algebra and rotation algebra: eliminations with and without a search for pivots, structured matrices, Newton's
method.

The eliminations were chosen by measurement, on XLA's CPU backend with one thread and in double precision. Times are in
microseconds for one matrix inside a compiled loop.

**Inverses of n × n matrices.** Gauss–Jordan elimination in a `fori_loop`, in the pivot order that a chart already has,
is at least as fast as LAPACK up to about 30 rows. A search for pivots in every elimination costs ten times as much, so
pivots are searched for only when a chart is made (`elimination`).

| n | 4 | 8 | 12 | 20 | 30 |
|---|---|---|---|---|---|
| LAPACK inverse | 0.7 | 1.1 | 2.2 | 4.3 | 8.6 |
| Gauss–Jordan in a known order | 0.1 | 0.55 | 1.25 | 4.3 | 8.0 |

Full pivoting with the search takes 1.5, 9 and 88 for matrices of 4 × 9, 8 × 12 and 20 × 21. Without the search, the
loop that rotates the pivot into the corner is nearly twice as fast as elimination in place up to 18 rows, and
elimination in place is faster than LAPACK's blocked elimination up to 40 rows. Code unrolled into scalars is fastest
for n = 4 but takes far too long to compile for n = 12. LAPACK's batched kernels have deadlocked inside loops (jaxlib
0.10.2), so members of a batch are eliminated one after the other.

**Chains of joints.** The Gram matrix `A M⁻¹ Aᵀ` of a chain of 100 links: dense 198, block-tridiagonal by `lax.scan`
over the joints 85, by cyclic reduction 13, by native code 1.9. A whole step of `Adams` on a chain of 5, 10, 20 and 35
rods takes 28, 46, 23 and 33 by blocks with a projection, and 39, 32, 111 and 1076 by coordinate partitioning. Blocks
are used from 30 rows on (`system/joint_graph.py`).

**Small blocks.** A batched dot of 2 × 2 or 3 × 3 blocks is a library call, whereas XLA fuses a sum of products with the
surrounding operations (`blocks`, `rotations`).
"""
