// Solve an LCP by the C library in C#: put liblavender.so (lavender.dll) beside the program.
//
//     cc -shared -fPIC -O2 -ffp-contract=off -DLAV_SHARED -o liblavender.so liblavender/lavender.c -lm
//     mcs -unsafe examples/c/Lcp.cs -out:lcp.exe && mono lcp.exe      (or `dotnet run`)
using System;
using System.Runtime.InteropServices;

// The fields of lav_problem up to `value`, in the order of lavender.h, and memory for the others: lav_default_problem
// writes the size of the struct into `size`.
[StructLayout(LayoutKind.Sequential)]
unsafe struct LavProblem {
    public uint size;
    public int form, law, nBlocks, nRows, nEntries, nBodies, nJoints, nVelocities, nMassEntries;
    public int* blockPtr, kind;
    public double* lower, upper, mu, patchRadius, b, target, velocity, compliance, impulse;
    public ulong* key;
    public int* order, indexPtr, index;
    public double* value;
    fixed byte rest[128];
}

static unsafe class Lavender {
    [DllImport("lavender")] public static extern int lav_self_test();
    [DllImport("lavender")] public static extern int lav_default_problem(int form, LavProblem* problem);
    [DllImport("lavender")] public static extern int lav_default_options(int method, byte* options);
    [DllImport("lavender")] public static extern int lav_default_budget(byte* budget);
    [DllImport("lavender")] public static extern int lav_open(
        void* memory, ulong bytes, LavProblem* largest, byte* options, void** solver);
    [DllImport("lavender")] public static extern int lav_set(void* solver, LavProblem* problem);
    [DllImport("lavender")] public static extern int lav_run(void* solver, byte* budget, int* result);
    [DllImport("lavender")] public static extern int lav_impulse(void* solver, double* impulse, int count);
}

static unsafe class Lcp {
    static void Check(int code) { if (code != 0) throw new InvalidOperationException("lavender: " + code); }

    // The impulses [N s] of rows with A [1/kg], row by row, and b [m/s]; all are >= 0.
    static double[] Solve(double[] A, double[] b) {
        const int Matrix = 1, Direct = 10;  // LAV_MATRIX, LAV_DIRECT
        var impulse = new double[b.Length];
        var lower = new double[b.Length];
        LavProblem problem;
        byte* options = stackalloc byte[64], budget = stackalloc byte[64];
        int* result = stackalloc int[18];
        result[0] = 72;  // size of lav_result
        Check(Lavender.lav_self_test());
        Check(Lavender.lav_default_problem(Matrix, &problem));
        Check(Lavender.lav_default_options(Direct, options));
        Check(Lavender.lav_default_budget(budget));
        fixed (double* value = A, right = b, low = lower, answer = impulse, memory = new double[4096]) {
            problem.nBlocks = problem.nRows = b.Length;
            problem.nEntries = A.Length;
            problem.value = value;
            problem.b = right;
            problem.lower = low;
            void* solver;
            Check(Lavender.lav_open(memory, 8 * 4096, &problem, options, &solver));
            Check(Lavender.lav_set(solver, &problem));
            Check(Lavender.lav_run(solver, budget, result));
            Check(Lavender.lav_impulse(solver, answer, b.Length));
        }
        return impulse;
    }

    static void Main() {
        Console.WriteLine(string.Join(" ", Solve(new[] { 2.0, 1.0, 1.0, 2.0 }, new[] { 1.0, -1.0 })));  // 0.5 0
    }
}
