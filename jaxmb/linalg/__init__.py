"""Linear algebra and rotation algebra: eliminations with and without a search for pivots, structured matrices, Newton's
method.

The eliminations were chosen by measurement, on XLA's CPU backend with one thread and in double precision. Times are in
microseconds for one matrix inside a compiled loop.

**Inverses of n × n matrices.** Gauss–Jordan elimination in a `fori_loop`, in the pivot order of a chart, is at least as
fast as LAPACK up to about 30 rows. A search for pivots in every elimination costs ten times as much, so pivots are
searched only when a chart is made (`elimination`).

| n | 4 | 8 | 12 | 20 | 30 |
|---|---|---|---|---|---|
| LAPACK inverse | 0.7 | 1.1 | 2.2 | 4.3 | 8.6 |
| Gauss–Jordan in a known order | 0.1 | 0.55 | 1.25 | 4.3 | 8.0 |

Full pivoting with the search takes 1.5, 9 and 88 for matrices of 4 × 9, 8 × 12 and 20 × 21. Without the search, the
loop that rotates the pivot into the corner is nearly twice as fast as elimination in place up to 18 rows. Elimination
in place is faster than LAPACK's blocked elimination up to 40 rows. Code unrolled into scalars is fastest for n = 4 but
takes far too long to compile for n = 12. LAPACK's batched kernels have deadlocked inside loops (jaxlib 0.10.2), so
members of a batch are eliminated one after the other.

**Many joints.** The Gram matrix `A M⁻¹ Aᵀ` couples joints that share a body. Its order of elimination follows from the
graph: many joints at once, in one loop over the steps of the order (`elimination_order`, `block_elimination`). On one
core, for a chain of 100 joints of two rows, the factor of the matrix takes 40 and a solution 30; for 1000 joints 400
and 75. The size of the program does not depend on the number of joints.

Recursion over a spanning tree, the sparse form of coordinate partitioning, needs as many operations but makes them one
after the other along each chain. In one process, for a chain of 100 pins, the linear algebra of a step took 48 by
elimination (one factor, four solutions, products). By recursion it took 240 (accelerations twice, four sweeps). For a
tree of 127 pins, seven deep, it took 80 and 96, without loops and changes of charts. So recursion is not offered.

**Small blocks.** A batched dot of 2 × 2 or 3 × 3 blocks is a library call, whereas XLA fuses a sum of products with the
surrounding operations (`blocks`, `rotations`). Written term by term, a product takes a third to a fifth of the time of
a reduction. But a product of products must not be fused: each entry would compute its operands again. A reduction over
some thousand numbers is a library call as well.
"""

from . import rotations as rotations
