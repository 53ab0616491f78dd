// A recorded problem in the memory of the module, ready to be swept and judged.

// Structs where the module has their fields: `put` makes one of pointers and 32-bit integers, `read` reads one.
function structsOf(k) {
  const all = Object.entries(k.layout.structs).map(([name, fields]) => [name, Object.keys(fields)]);
  let next = k.alloc(4 * all.reduce((count, [, fields]) => count + 1 + fields.length, 0));
  k.functions.lav_layout(next);
  const number = () => k.i32((next += 4) - 4, 1)[0];
  const places = Object.fromEntries(all.map(([name, fields]) => (
    [name, { size: number(), at: Object.fromEntries(fields.map((field) => [field, number()])) }]
  )));
  return {
    put(name, values) {
      const struct = k.alloc(places[name].size);
      for (const [field, value] of Object.entries(values)) {
        k.i32(struct + places[name].at[field], 1)[0] = value;
      }
      return struct;
    },
    read(name, struct) {
      return Object.fromEntries(Object.entries(k.layout.structs[name]).map(([field, type]) => (
        [field, (type === "f8" ? k.f64 : k.i32).call(k, struct + places[name].at[field], 1)[0]]
      )));
    },
    size: (name) => places[name].size,
  };
}

// `recorded` gives the bytes of a place in the recording.
export function load(k, problem, recorded) {
  const f = k.functions;
  const structs = structsOf(k);
  const { blocks, rows, bodies, joints, contacts } = problem.counts;
  const put = {};
  for (const [name, place] of [...Object.entries(problem.ints), ...Object.entries(problem.reals)]) {
    const bytes = recorded(place);
    put[name] = k.alloc(Math.max(8, bytes.length));
    k.bytes(put[name], bytes.length).set(bytes);
  }
  const out = { impulse: put.start };
  for (const name of ["d", "nu", "step", "slack", "error"]) {
    out[name] = k.alloc(8 * (rows + 1));
  }
  const p = structs.put("blocks_t", {
    n_blocks: blocks, n_rows: rows, law: problem.law, ptr: put.ptr, kind: put.kind, lower: put.lower, upper: put.upper,
    mu: put.mu, patch_radius: put.patch_radius, b: put.b, d: out.d, nu: out.nu, step: out.step,
  });
  const empty = k.alloc(4 * (rows + 1));
  const rng = k.alloc(8);
  k.u64(rng, 1)[0] = BigInt(problem.seed);
  const score = k.alloc(structs.size("score_t"));
  const order = [put.order, problem.split, problem.mode, rng];
  let first = 1;
  if (problem.factored) {
    const more = { minv_jac: 96 * (rows + 1), coupling: 40 * (contacts + 1), swing: 48 * (rows + 1) };
    for (const [name, size] of Object.entries(more)) {
      put[name] = k.alloc(size);
    }
    const r = structs.put("rows_t", {
      n_bodies: bodies, n_joints: joints, n_contacts: contacts, jac: put.jac, minv_jac: put.minv_jac,
      joint_body: put.joint_body, normal: put.normal, tangent: put.tangent, arm_a: put.arm_a, arm_b: put.arm_b,
      contact_body: put.contact_body, coupling: put.coupling, swing: put.swing, inv_mass: put.inv_mass,
      inv_inertia: put.inv_inertia, compliance: put.compliance,
    });
    const velocity = k.alloc(48 * (bodies + 1));
    const scratch = k.alloc(96 * (bodies + 1));
    f.lav_rows_diagonal(p, r, out.d, out.nu, out.step, empty, put.minv_jac, put.coupling, put.swing);
    f.lav_rows_velocity(p, r, out.impulse, velocity);
    return {
      out,
      sweep(n) {
        f.lav_impulse_sweeps(p, r, out.impulse, velocity, ...order, first, n);
        first = 0;
      },
      judge() {
        f.lav_judge_rows(p, r, out.impulse, out.slack, out.error, scratch, 1, score);
        return structs.read("score_t", score);
      },
    };
  }
  const a = structs.put("csr_t", { indptr: put.indptr, indices: put.indices, data: put.data });
  f.lav_csr_diagonal(p, a, out.d, out.step, empty);
  f.lav_matrix_nu(p, out.nu);
  return {
    out,
    // inOrder: row by row without the order array, where every block is one row and the order is as given.
    sweep(n, inOrder = false) {
      if (inOrder) {
        f.lav_pgs_rows_in_order(p, a, out.impulse, n);
      } else {
        f.lav_pgs_sweeps(p, a, out.impulse, ...order, first, n);
      }
      first = 0;
    },
    judge() {
      f.lav_judge_csr(p, a, out.impulse, out.slack, out.error, 1, score);
      return structs.read("score_t", score);
    },
  };
}
