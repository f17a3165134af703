/* The matrix steps of a block of the Kalman filter, without the overhead of a dozen calls of numpy.

   ccatp.filters._kernel in the compiled build. The functions compute what survey_model.py, kalman.py and conditioning.py
   compute with numpy, in another order of additions: results agree to rounding. What is out of the ordinary (other types or
   layouts, numbers that are not finite, rows too strong for a difference of covariances) they leave to those: they
   return None and have changed nothing. */

#define PY_SSIZE_T_CLEAN
#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <Python.h>
#include <math.h>
#include <numpy/arrayobject.h>

#define STATES 32 /* more go to numpy, where its overhead no longer counts */
#define ROWS 12

/* As in ccatp/filters/base.py and conditioning.py. */
static const double HUGE_SQUARES = 1e200, STRONGEST = 1e6, LEAST_PIVOT = 1e-3;
/* Beyond it numpy's square root is asked: a gain that errs by 1e-16 of itself no longer leaves enough digits. */
static const double TOO_STRONG = 1e8;

/* The numbers of a C-ordered array of doubles of this shape (columns < 0: one axis), or NULL. */
static const double *numbers(PyObject *object, npy_intp rows, npy_intp columns)
{
    if (!PyArray_Check(object)) return NULL;
    PyArrayObject *array = (PyArrayObject *)object;
    const int axes = columns < 0 ? 1 : 2;
    if (PyArray_TYPE(array) != NPY_DOUBLE || !PyArray_ISCARRAY_RO(array) || PyArray_NDIM(array) != axes) return NULL;
    if (PyArray_DIM(array, 0) != rows || (axes == 2 && PyArray_DIM(array, 1) != columns)) return NULL;
    return PyArray_DATA(array);
}

static npy_intp length(PyObject *object)
{
    return PyArray_Check(object) && PyArray_NDIM((PyArrayObject *)object) > 0 ? PyArray_DIM((PyArrayObject *)object, 0)
                                                                             : -1;
}

static double squares(const double *x, int count)
{
    double sum = 0.0;
    for (int i = 0; i < count; i++) sum += x[i] * x[i];
    return sum;
}

/* advance(P, F, Q): F P F^T + Q, symmetric to the last bit. F has few entries beside its diagonal, so zeros are left
   out: their product with a number that is not finite is not, and then the result is looked at again by numpy. */
static PyObject *advance(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t count)
{
    if (count != 3) return PyErr_Format(PyExc_TypeError, "advance takes P, F and Q");
    const npy_intp size = length(args[0]);
    const double *P = NULL, *F = NULL, *Q = NULL;
    if (size >= 1 && size <= STATES) {
        P = numbers(args[0], size, size), F = numbers(args[1], size, size), Q = numbers(args[2], size, size);
    }
    if (!P || !F || !Q) Py_RETURN_NONE;
    const int n = (int)size;
    int used[STATES][STATES], uses[STATES];
    double FP[STATES][STATES];
    for (int i = 0; i < n; i++) {
        int k = 0;
        for (int j = 0; j < n; j++) {
            used[i][k] = j;
            k += F[i * n + j] != 0.0; /* true for a number that is none */
            FP[i][j] = 0.0;
        }
        uses[i] = k;
        for (int u = 0; u < k; u++) {
            const double f = F[i * n + used[i][u]], *row = P + (size_t)used[i][u] * n;
            for (int j = 0; j < n; j++) FP[i][j] += f * row[j];
        }
    }
    npy_intp shape[2] = {n, n};
    PyArrayObject *result = (PyArrayObject *)PyArray_SimpleNew(2, shape, NPY_DOUBLE);
    if (!result) return NULL;
    double *out = PyArray_DATA(result);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = 0.0;
            for (int u = 0; u < uses[j]; u++) sum += FP[i][used[j][u]] * F[j * n + used[j][u]];
            out[i * n + j] = out[j * n + i] = sum + 0.5 * (Q[i * n + j] + Q[j * n + i]);
        }
    }
    if (!(squares(P, n * n) + squares(out, n * n) < HUGE_SQUARES)) {
        Py_DECREF(result);
        Py_RETURN_NONE;
    }
    return (PyObject *)result;
}

/* spread(G, variances, drift): G diag(variances) G^T + diag(drift), the noise of a step. */
static PyObject *spread(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t count)
{
    if (count != 3) return PyErr_Format(PyExc_TypeError, "spread takes G, variances and drift");
    const npy_intp n = length(args[0]), m = length(args[1]);
    const double *G = numbers(args[0], n, m), *variances = numbers(args[1], m, -1), *drift = numbers(args[2], n, -1);
    if (!G || !variances || !drift) Py_RETURN_NONE;
    npy_intp shape[2] = {n, n};
    PyArrayObject *result = (PyArrayObject *)PyArray_SimpleNew(2, shape, NPY_DOUBLE);
    if (!result) return NULL;
    double *out = PyArray_DATA(result);
    for (npy_intp i = 0; i < n; i++) {
        for (npy_intp j = 0; j <= i; j++) {
            double sum = 0.0;
            for (npy_intp k = 0; k < m; k++) sum += G[i * m + k] * variances[k] * G[j * m + k];
            out[i * n + j] = out[j * n + i] = i == j ? sum + drift[i] : sum;
        }
    }
    return (PyObject *)result;
}

enum strength { REFUSED, WEAK, STRONG };

/* Cholesky factor of S (m, m) in place, lower; refused where a row is too strong or repeats those before it. */
static enum strength factored(double S[ROWS][ROWS], const double *R, int m)
{
    enum strength found = WEAK;
    for (int i = 0; i < m; i++) {
        const double total = S[i][i];
        for (int j = 0; j <= i; j++) {
            double sum = S[i][j];
            for (int k = 0; k < j; k++) sum -= S[i][k] * S[j][k];
            if (j < i) {
                S[i][j] = sum / S[j][j];
            } else {
                /* One row leaves its whole variance: R <= S says that P is no covariance where it does not hold. */
                if (!(R[i] > 0.0 && total < TOO_STRONG * R[i] && sum > LEAST_PIVOT * total && total >= R[i])) return REFUSED;
                if (!(total < STRONGEST * R[i])) found = STRONG;
                S[i][i] = sqrt(sum);
            }
        }
    }
    return found;
}

/* The posterior of strong rows, Joseph's form: A P A^T + W R W^T with A = I - W H and W = P H^T S^-1. No covariances are
   subtracted, and what W errs by enters squared. V and the factor of S as in condition. */
static void join(double *out, const double *P, const double *H, const double *R, double V[ROWS][STATES],
                 double S[ROWS][ROWS], int n, int m)
{
    double W[ROWS][STATES], A[STATES][STATES], AP[STATES][STATES];
    int seen[STATES], is_seen[STATES], count = 0;
    for (int k = 0; k < n; k++) {
        is_seen[k] = 0;
        for (int a = 0; a < m; a++) is_seen[k] |= H[a * n + k] != 0.0;
        if (is_seen[k]) seen[count++] = k;
    }
    for (int a = m - 1; a >= 0; a--) {
        for (int i = 0; i < n; i++) {
            double w = V[a][i];
            for (int b = a + 1; b < m; b++) w -= S[b][a] * W[b][i];
            W[a][i] = w / S[a][a];
        }
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) AP[i][j] = is_seen[i] ? 0.0 : P[i * n + j];
        for (int s = 0; s < count; s++) {
            const int k = seen[s];
            double entry = i == k;
            for (int a = 0; a < m; a++) entry -= W[a][i] * H[a * n + k];
            A[i][k] = entry;
            for (int j = 0; j < n; j++) AP[i][j] += entry * P[k * n + j];
        }
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = is_seen[j] ? 0.0 : AP[i][j];
            for (int s = 0; s < count; s++) sum += AP[i][seen[s]] * A[j][seen[s]];
            for (int a = 0; a < m; a++) sum += W[a][i] * R[a] * W[a][j];
            out[i * n + j] = out[j * n + i] = sum;
        }
    }
}

/* condition(P, nu, H, R): (change of the mean, covariance, normalised innovation squared) of N(., P) on z = H x + noise
   with the residual nu and the variances R, see Conditioner. */
static PyObject *condition(PyObject *Py_UNUSED(module), PyObject *const *args, Py_ssize_t count)
{
    if (count != 4) return PyErr_Format(PyExc_TypeError, "condition takes P, nu, H and R");
    const npy_intp size = length(args[0]), rows = length(args[1]);
    const double *P = NULL, *nu = NULL, *H = NULL, *R = NULL;
    if (size >= 1 && size <= STATES && rows >= 1 && rows <= ROWS && rows <= size) {
        P = numbers(args[0], size, size), nu = numbers(args[1], rows, -1);
        H = numbers(args[2], rows, size), R = numbers(args[3], rows, -1);
    }
    if (!P || !nu || !H || !R) Py_RETURN_NONE;
    const int n = (int)size, m = (int)rows;
    if (!(squares(H, m * n) + squares(nu, m) + squares(P, n * n) < HUGE_SQUARES)) Py_RETURN_NONE;

    /* S = H P H^T + R = C C^T, V = P H^T C^-T, y = C^-1 nu; V is kept transposed, a row for each row of H. */
    double V[ROWS][STATES], S[ROWS][ROWS], y[ROWS], nis = 0.0;
    for (int a = 0; a < m; a++) {
        for (int j = 0; j < n; j++) V[a][j] = 0.0;
        for (int k = 0; k < n; k++) {
            const double h = H[a * n + k];
            if (h == 0.0) continue;
            for (int j = 0; j < n; j++) V[a][j] += h * P[k * n + j];
        }
    }
    for (int a = 0; a < m; a++) {
        for (int b = 0; b <= a; b++) {
            double sum = a == b ? R[a] : 0.0;
            for (int k = 0; k < n; k++) sum += V[a][k] * H[b * n + k];
            S[a][b] = sum;
        }
    }
    const enum strength strength = factored(S, R, m);
    if (strength == REFUSED) Py_RETURN_NONE;
    for (int a = 0; a < m; a++) {
        y[a] = nu[a];
        for (int b = 0; b < a; b++) {
            const double s = S[a][b];
            y[a] -= s * y[b];
            for (int j = 0; j < n; j++) V[a][j] -= s * V[b][j];
        }
        const double per_pivot = 1.0 / S[a][a];
        y[a] *= per_pivot;
        nis += y[a] * y[a];
        for (int j = 0; j < n; j++) V[a][j] *= per_pivot;
    }

    npy_intp shape[2] = {n, n};
    PyArrayObject *change = (PyArrayObject *)PyArray_SimpleNew(1, shape, NPY_DOUBLE);
    PyArrayObject *covariance = (PyArrayObject *)PyArray_SimpleNew(2, shape, NPY_DOUBLE);
    if (!change || !covariance) {
        Py_XDECREF(change);
        Py_XDECREF(covariance);
        return NULL;
    }
    double *dx = PyArray_DATA(change), *out = PyArray_DATA(covariance), least = 0.0;
    for (int i = 0; i < n; i++) {
        dx[i] = 0.0;
        for (int a = 0; a < m; a++) dx[i] += V[a][i] * y[a];
        for (int j = 0; j < n; j++) {
            double sum = 0.0;
            for (int a = 0; a < m; a++) sum += V[a][i] * V[a][j];
            out[i * n + j] = P[i * n + j] - sum;
        }
    }
    if (strength == STRONG) join(out, P, H, R, V, S, n, m);
    for (int i = 0; i < n; i++) least = fmin(least, out[i * n + i]);
    if (!(least >= 0.0 && nis < HUGE_SQUARES)) {
        Py_DECREF(change);
        Py_DECREF(covariance);
        Py_RETURN_NONE;
    }
    return Py_BuildValue("(NNd)", change, covariance, nis);
}

static PyMethodDef functions[] = {
    {"advance", (PyCFunction)(void (*)(void))advance, METH_FASTCALL, "advance(P, F, Q): F P F^T + Q, or None."},
    {"condition", (PyCFunction)(void (*)(void))condition, METH_FASTCALL, "condition(P, nu, H, R): posterior, or None."},
    {"spread", (PyCFunction)(void (*)(void))spread, METH_FASTCALL, "spread(G, variances, drift): Q, or None."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_kernel", NULL, -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void)
{
    import_array();
    return PyModule_Create(&module);
}
