# Every table and figure of a study's report, computed from the CSV files of its export. Base R (4.1 or newer) alone.
#
#   Rscript analysis.R                      reads csv/ beside this file, writes tables and figures into analysis/
#   Rscript analysis.R some/csv some/folder
#
# Written to be read and changed: the same tables as analysis.py, under the same names. Empty cells are what could not
# be computed (too few people, no spread). A difference is always second minus first. Meanings: dictionary.md.
# One number cannot be the same: where a permutation test has too many ways to divide people, R draws other ones.

SCALES <- c("satisfaction", "personalisation")
WINDOW <- 30
FIRST_POINT <- 5
Z <- 1.959964
NAMES <- c(
  reference = "Pre-trained policy", prefft = "PrefFT", prefft_anchored = "PrefFT, anchored", pbarl = "PbARL",
  pbarl_printed = "PbARL as printed", somebody_else = "Somebody else's filter", average = "Average filter",
  self_set = "Set by the person"
)
COSTS <- c("C_d", "C_v", "C_f", "C_hf", "C_fd", "C_fdv")

# --- reading ---

read_study <- function(folder) {
  read <- function(name) {
    path <- file.path(folder, paste0(name, ".csv"))
    if (!file.exists(path)) stop(path, " is not there. Unpack the whole zip file of the export.", call. = FALSE)
    read.csv(path, na.strings = "", stringsAsFactors = FALSE, encoding = "UTF-8")
  }
  names <- c("participants", "queries", "evaluations", "forms", "scores", "scoring_key", "headtoheads", "ratings", "methods")
  study <- sapply(names, read, simplify = FALSE)
  study$all_ratings <- study$ratings
  # Until a study is unblinded there are letters alone, and a letter is another method for everybody.
  study$blinded <- nrow(study$ratings) > 0 && all(is.na(study$ratings$method))
  study$groups <- if (study$blinded) LETTERS[seq_len(nrow(study$methods))] else as.character(study$methods$method)
  study$ratings$group <- as.character(if (study$blinded) study$ratings$letter else study$ratings$method)
  counts <- yes(study$ratings$counts) & study$ratings$group %in% study$groups
  study$ratings <- study$ratings[counts & complete.cases(study$ratings[SCALES]), ]
  study$between <- any(!is.na(study$participants$arm))
  study$bound <- study$methods$equivalence_bound[1] # points; the study's smallest difference that matters
  study
}

yes <- function(column) tolower(as.character(column)) %in% "true"

row_of <- function(...) as.data.frame(list(...), stringsAsFactors = FALSE)

stack_rows <- function(rows) {
  rows <- Filter(function(each) !is.null(each) && nrow(each) > 0, rows)
  columns <- unique(unlist(lapply(rows, names)))
  filled <- lapply(rows, function(each) {
    each[setdiff(columns, names(each))] <- NA
    each[columns]
  })
  do.call(rbind, filled)
}

# --- what is computed from numbers alone ---

mean_interval <- function(values, lowest = -Inf, highest = Inf) {
  if (length(values) < 3) return(c(NA, NA))
  margin <- qt(0.975, length(values) - 1) * sd(values) / sqrt(length(values))
  c(max(mean(values) - margin, lowest), min(mean(values) + margin, highest))
}

wilson <- function(correct, scored) {
  share <- correct / scored
  centre <- (share + Z^2 / (2 * scored)) / (1 + Z^2 / scored)
  half <- Z * sqrt(share * (1 - share) / scored + Z^2 / (4 * scored^2)) / (1 + Z^2 / scored)
  c(max(0, centre - half), min(1, centre + half))
}

# Holm's p values; a test without a result still counts in the family.
holm <- function(p) {
  corrected <- rep(NA_real_, length(p))
  known <- which(!is.na(p))
  corrected[known] <- p.adjust(p[known], "holm", n = length(p))
  corrected
}

# The noncentral t distribution of which this share lies below t.
noncentrality <- function(t, freedom, share_below) {
  excess <- function(nc) suppressWarnings(pt(t, freedom, nc)) - share_below
  step <- 0.25 * (1 + abs(t)) * (if (excess(t) > 0) 1 else -1)
  inner <- t
  outer <- t + step
  while (excess(outer) * excess(inner) > 0) {
    inner <- outer
    outer <- outer + step
  }
  uniroot(excess, sort(c(inner, outer)), tol = 1e-12)$root
}

spread_of <- function(values) diff(range(values))

# The paper's test, which counts ratings and not people: mind that several come from one person.
two_sample_t <- function(first, second) {
  if (min(length(first), length(second)) < 2 || (spread_of(first) == 0 && spread_of(second) == 0)) return(NULL)
  found <- t.test(second, first, var.equal = TRUE)
  row_of(
    n_first = length(first), n_second = length(second), difference = mean(second) - mean(first),
    statistic = unname(found$statistic), degrees_of_freedom = unname(found$parameter), p = found$p.value
  )
}

paired_t <- function(differences) {
  n <- length(differences)
  if (n < 3 || spread_of(differences) == 0) return(NULL)
  found <- t.test(differences)
  t <- unname(found$statistic)
  row_of(
    n = n, difference = mean(differences), low = found$conf.int[1], high = found$conf.int[2], statistic = t,
    degrees_of_freedom = n - 1, p = found$p.value, d_z = mean(differences) / sd(differences),
    d_z_low = noncentrality(t, n - 1, 0.975) / sqrt(n), d_z_high = noncentrality(t, n - 1, 0.025) / sqrt(n)
  )
}

# Signed-rank test, zeros dropped, exact given the ties: the sums of ranks over all signs, rank by rank.
wilcoxon <- function(differences) {
  moved <- differences[differences != 0]
  if (length(differences) < 3 || length(moved) == 0) return(NULL)
  ranks <- rank(abs(moved))
  chances <- 1
  for (each in round(2 * ranks)) chances <- 0.5 * (c(chances, rep(0, each)) + c(rep(0, each), chances))
  positive <- sum(ranks[moved > 0])
  smaller <- min(positive, sum(ranks) - positive)
  n <- length(moved)
  found <- row_of(
    n = length(differences), n_without_ties = n, median = median(differences), statistic = smaller,
    p = min(1, 2 * sum(chances[seq_len(round(2 * smaller) + 1)])), smallest_p = 2^(1 - n),
    rank_biserial = (2 * positive - sum(ranks)) / sum(ranks)
  )
  # Wilson's interval of a share of so many trials: as variable as these ranks.
  trials <- 3 * n * (n + 1) / (2 * (2 * n + 1))
  ends <- 2 * wilson(trials * positive / sum(ranks), trials) - 1
  found$rank_biserial_low <- max(ends[1], -1)
  found$rank_biserial_high <- min(ends[2], 1)
  found
}

# rating ~ group + (group | person), in two stages: Paule and Mandel's variance, Hartung and Knapp's error.
# first, second: per person the ratings of each group.
mixed_model <- function(first, second) {
  differences <- as.numeric(mapply(function(a, b) mean(b) - mean(a), first, second))
  n <- length(differences)
  cells <- c(first, second)
  if (n < 3 || spread_of(round(differences, 12)) == 0) return(NULL)
  freedom <- sum(lengths(cells) - 1)
  within <- if (freedom > 0) sum(sapply(cells, function(cell) sum((cell - mean(cell))^2))) / freedom else NA
  if (!is.na(within) && within > 0) {
    noise <- within * (1 / lengths(first) + 1 / lengths(second))
    weighted <- function(tau2) sum(differences / (noise + tau2)) / sum(1 / (noise + tau2))
    excess <- function(tau2) sum((differences - weighted(tau2))^2 / (noise + tau2)) - (n - 1)
    between <- 0
    if (excess(0) > 0) between <- uniroot(excess, c(0, 100 * (var(differences) + max(noise))), tol = 1e-14)$root
    weights <- 1 / (noise + between)
    m <- weighted(between)
    error <- sqrt(sum(weights * (differences - m)^2) / (n - 1) / sum(weights))
  } else {
    m <- mean(differences)
    error <- sd(differences) / sqrt(n)
    between <- var(differences)
  }
  margin <- qt(0.975, n - 1) * error
  row_of(
    n = n, n_ratings = sum(lengths(cells)), difference = m, standard_error = error, low = m - margin, high = m + margin,
    statistic = m / error, degrees_of_freedom = n - 1, p = 2 * pt(-abs(m / error), n - 1),
    sd_between_people = sqrt(between), sd_within_people = sqrt(within)
  )
}

# Ratings as an order: proportional odds, rating ~ group + (1 | person), errors that count people (sandwich).
# ordinal::clmm(rating ~ group + (1 | person), nAGQ = 10) has the same estimates; its own errors suppose one effect for
# everybody.
cumulative_link <- function(first, second) {
  n <- length(first)
  if (n < 4) return(NULL)
  fit <- fit_two(first, second, c(seq_len(n), seq_len(n)))
  if (is.null(fit)) return(NULL)
  odds_of(fit, n / (n - 1) * sum(fit$influences^2), n - 1, row_of(n = n, n_ratings = length(unlist(c(first, second)))))
}

# The same of different people: a variance for each group, and Welch's degrees of freedom.
cumulative_link_between <- function(first, second) {
  n <- c(length(first), length(second))
  if (min(n) < 3) return(NULL)
  fit <- fit_two(first, second, seq_len(sum(n)))
  if (is.null(fit)) return(NULL)
  variances <- n / (n - 1) * c(sum(fit$influences[seq_len(n[1])]^2), sum(fit$influences[-seq_len(n[1])]^2))
  counts <- row_of(n_first = n[1], n_second = n[2], n_ratings = length(unlist(c(first, second))))
  odds_of(fit, sum(variances), sum(variances)^2 / sum(variances^2 / (n - 1)), counts)
}

# Effect, SD, and what each person moves the effect by; people: whose each cell is. NULL: no finite ones fit.
fit_two <- function(first, second, people) {
  cells <- c(first, second)
  ratings <- unlist(cells)
  if (spread_of(ratings) == 0) return(NULL)
  x <- rep(0:1, c(length(unlist(first)), length(unlist(second))))
  model <- ordered_ratings(ratings, x, rep(people, lengths(cells)))
  found <- model$fit()
  scores <- model$scores(found)$scores
  effect <- found[model$cuts + 1]
  sd <- abs(found[model$cuts + 2])
  if (abs(effect) > 12 || sd > 8 || max(abs(colSums(scores))) > 1e-6) return(NULL)
  list(effect = effect, sd = sd, influences = as.numeric(scores %*% solve_symmetric(model$information(found))[, model$cuts + 1]))
}

odds_of <- function(fit, variance, freedom, counts) {
  error <- sqrt(variance)
  if (error < 1e-6) return(NULL)
  ends <- fit$effect + c(-1, 1) * qt(0.975, freedom) * error
  cbind(counts, row_of(
    difference = fit$effect, standard_error = error, low = ends[1], high = ends[2], odds_ratio = exp(fit$effect),
    odds_ratio_low = exp(ends[1]), odds_ratio_high = exp(ends[2]), statistic = fit$effect / error,
    degrees_of_freedom = freedom, p = 2 * pt(-abs(fit$effect / error), freedom), sd_between_people = fit$sd
  ))
}

solve_symmetric <- function(matrix) {
  parts <- eigen(matrix, symmetric = TRUE)
  kept <- abs(parts$values) > 1e-15 * max(abs(parts$values))
  parts$vectors[, kept, drop = FALSE] %*% (t(parts$vectors[, kept, drop = FALSE]) / parts$values[kept])
}

# The marginal likelihood of thresholds, effect and the people's standard deviation, on a fine grid of levels.
ordered_ratings <- function(ratings, x, person) {
  levels <- match(ratings, sort(unique(ratings)))
  cuts <- max(levels) - 1
  grid <- seq(-8, 8, length.out = 161)
  log_weights <- dnorm(grid, log = TRUE) + log(grid[2] - grid[1])
  scores <- function(values) {
    ends <- c(-Inf, values[seq_len(cuts)], Inf)
    shift <- outer(values[cuts + 1] * x, values[cuts + 2] * grid, "+")
    at_most <- plogis(ends[levels + 1] - shift)
    at_least <- plogis(shift - ends[levels])
    chance <- pmax(at_most * at_least * -expm1(ends[levels] - ends[levels + 1]), 1e-300)
    logs <- sweep(rowsum(log(chance), person), 2, log_weights, "+")
    most <- apply(logs, 1, max)
    likelihoods <- most + log(rowSums(exp(logs - most)))
    weights <- exp(logs - likelihoods)[person, , drop = FALSE]
    slopes <- weights * (at_most - at_least)
    at_upper <- rowSums(weights * at_most * (1 - at_most) / chance)
    at_lower <- rowSums(weights * at_least * (1 - at_least) / chance)
    of_cuts <- sapply(seq_len(cuts), function(cut) at_upper * (levels == cut) - at_lower * (levels == cut + 1))
    list(
      likelihood = sum(likelihoods),
      scores = rowsum(cbind(of_cuts, rowSums(slopes) * x, slopes %*% grid), person)
    )
  }
  information <- function(values, step = 1e-5) {
    found <- sapply(seq_along(values), function(i) {
      moved <- replace(numeric(length(values)), i, step)
      (colSums(scores(values - moved)$scores) - colSums(scores(values + moved)$scores)) / (2 * step)
    })
    (found + t(found)) / 2
  }
  # The first threshold and the logarithms of the gaps between them, effect, SD.
  ordered <- function(free) c(cumsum(c(free[1], exp(free[seq_len(cuts)[-1]]))), free[cuts + 1:2])
  gradient <- function(free) {
    found <- colSums(scores(ordered(free))$scores)
    found[seq_len(cuts)] <- rev(cumsum(rev(found[seq_len(cuts)])))
    gaps <- seq_len(cuts)[-1]
    found[gaps] <- found[gaps] * exp(free[gaps])
    -found
  }
  fit <- function() {
    start <- qlogis(cumsum(tabulate(levels))[seq_len(cuts)] / length(levels))
    best <- optim(
      c(start[1], log(diff(start)), 0, 1), function(free) -scores(ordered(free))$likelihood, gradient,
      method = "L-BFGS-B", lower = c(-30, rep(-12, cuts - 1), -13, -13), upper = c(30, rep(3.5, cuts - 1), 13, 13),
      control = list(factr = 1e3, maxit = 1000)
    )
    values <- ordered(best$par)
    step <- solve_symmetric(information(values))
    for (each in 1:3) values <- values + as.numeric(step %*% colSums(scores(values)$scores)) # Newton: the last digits
    values
  }
  list(cuts = cuts, scores = scores, information = information, fit = fit)
}

# Two one-sided paired t-tests (Schuirmann 1987): p below .05 shows that the means are less than bound apart.
equivalence <- function(differences, bound) {
  n <- length(differences)
  if (n < 3 || spread_of(differences) == 0) return(NULL)
  above <- t.test(differences, mu = -bound, alternative = "greater")
  below <- t.test(differences, mu = bound, alternative = "less")
  ends <- t.test(differences, conf.level = 0.90)$conf.int
  row_of(
    n = n, difference = mean(differences), low_90 = ends[1], high_90 = ends[2], bound = bound,
    statistic = min(above$statistic, -below$statistic), degrees_of_freedom = n - 1, p = max(above$p.value, below$p.value)
  )
}

can_be_compared <- function(first, second) {
  min(length(first), length(second)) >= 3 && (spread_of(first) > 0 || spread_of(second) > 0)
}

# Welch's test of people who met one of the two methods, with Hedges' g.
welch_t <- function(first, second) {
  if (!can_be_compared(first, second)) return(NULL)
  found <- t.test(second, first)
  freedom <- length(first) + length(second) - 2
  scale <- sqrt(1 / length(first) + 1 / length(second))
  small <- exp(lgamma(freedom / 2) - lgamma((freedom - 1) / 2)) / sqrt(freedom / 2)
  within <- sum((first - mean(first))^2) + sum((second - mean(second))^2)
  g <- (mean(second) - mean(first)) / sqrt(within / freedom)
  row_of(
    n_first = length(first), n_second = length(second), difference = mean(second) - mean(first),
    low = found$conf.int[1], high = found$conf.int[2], statistic = unname(found$statistic),
    degrees_of_freedom = unname(found$parameter), p = found$p.value, g = small * g,
    g_low = small * noncentrality(g / scale, freedom, 0.975) * scale,
    g_high = small * noncentrality(g / scale, freedom, 0.025) * scale
  )
}

# Two one-sided Welch tests, of people who met one of the two methods.
equivalence_between <- function(first, second, bound) {
  if (!can_be_compared(first, second)) return(NULL)
  above <- t.test(second, first, mu = -bound, alternative = "greater")
  below <- t.test(second, first, mu = bound, alternative = "less")
  ends <- t.test(second, first, conf.level = 0.90)$conf.int
  row_of(
    n_first = length(first), n_second = length(second), difference = mean(second) - mean(first), low_90 = ends[1],
    high_90 = ends[2], bound = bound, statistic = min(above$statistic, -below$statistic),
    degrees_of_freedom = unname(above$parameter), p = max(above$p.value, below$p.value)
  )
}

# Welch's statistic among all ways to divide the people, or among that many drawn ones.
permutation <- function(first, second, most = 20000, seed = 112) {
  if (!can_be_compared(first, second)) return(NULL)
  values <- c(first, second)
  size <- length(first)
  exact <- choose(length(values), size) <= most
  if (exact) {
    ways <- combn(length(values), size, simplify = FALSE)
  } else {
    set.seed(seed)
    ways <- c(list(seq_len(size)), replicate(most, sample(length(values), size), simplify = FALSE))
  }
  found <- abs(vapply(ways, function(way) welch_statistic(values[way], values[-way]), 0))
  row_of(
    n_first = size, n_second = length(second), difference = mean(second) - mean(first),
    p = mean(found >= abs(welch_statistic(first, second)) - 1e-9), exact = exact, ways = length(ways)
  )
}

welch_statistic <- function(first, second) {
  difference <- mean(second) - mean(first)
  error <- var(first) / length(first) + var(second) / length(second)
  if (abs(difference) < 1e-12) return(0)
  if (error < 1e-12) sign(difference) * Inf else difference / sqrt(error)
}

# Cronbach's alpha with Feldt's interval, McDonald's omega, of two items Spearman-Brown. items: people x items
reliability <- function(items) {
  found <- row_of(people = nrow(items), items = ncol(items))
  if (ncol(items) < 2 || nrow(items) < 3) return(found)
  covariance <- cov(items)
  if (sum(covariance) <= 0 || any(diag(covariance) <= 0)) return(found)
  k <- ncol(items)
  found$alpha <- k / (k - 1) * (1 - sum(diag(covariance)) / sum(covariance))
  freedom <- c(nrow(items) - 1, (nrow(items) - 1) * (k - 1))
  found$low <- 1 - (1 - found$alpha) * qf(0.975, freedom[1], freedom[2])
  found$high <- 1 - (1 - found$alpha) * qf(0.025, freedom[1], freedom[2])
  if (k == 2) {
    r <- cor(items)[1, 2]
    found$spearman_brown <- 2 * r / (1 + r)
  } else {
    found$omega <- omega(covariance, nrow(items))
  }
  found
}

# Of one factor, by maximum likelihood over the unique variances, at least 0.005 of each item (as factanal() does, which
# gives up where its optimiser has done what it can). With few people there are several maxima: the best is sought from
# factanal's start and from one for every item. NA where it cannot be fitted.
omega <- function(covariance, people) {
  correlation <- cov2cor(covariance)
  if (people <= nrow(covariance) || min(eigen(correlation, TRUE, TRUE)$values) < 1e-8) return(NA_real_)
  k <- nrow(correlation)
  spectrum <- function(unique) eigen(correlation / sqrt(outer(unique, unique)), symmetric = TRUE)
  loadings <- function(unique) {
    found <- spectrum(unique)
    sqrt(unique) * found$vectors[, 1] * sqrt(max(found$values[1] - 1, 0))
  }
  misfit <- function(unique) {
    rest <- spectrum(unique)$values[-1]
    sum(rest - log(rest) - 1)
  }
  gradient <- function(unique) diag(outer(loadings(unique), loadings(unique)) + diag(unique) - correlation) / unique^2
  fitted <- function(start, ...) {
    optim(start, misfit, gradient, method = "L-BFGS-B", lower = 0.005, upper = 1, control = list(...))
  }
  usual <- (1 - 0.5 / k) / diag(solve(correlation))
  starts <- c(list(usual), lapply(seq_len(k), function(item) replace(rep(0.9, k), item, 0.1)))
  roughly <- lapply(starts, fitted)
  best <- roughly[[which.min(sapply(roughly, function(each) each$value))]]$par
  unique <- fitted(best, factr = 1, pgtol = 1e-10, maxit = 10000, parscale = rep(0.01, k))$par
  scale <- sqrt(diag(covariance))
  common <- sum(loadings(unique) * scale)^2
  common / (common + sum(unique * scale^2))
}

# --- ratings ---

means_of <- function(rows, value, groups, lowest = 1, highest = 5) {
  stack_rows(lapply(groups, function(group) {
    mine <- rows[rows$group == group, ]
    people <- as.numeric(tapply(mine[[value]], mine$participant, mean))
    interval <- mean_interval(people, lowest, highest)
    row_of(
      group = group, ratings = nrow(mine), participants = length(people),
      mean = if (nrow(mine)) mean(mine[[value]]) else NA, sd = if (nrow(mine) > 1) sd(mine[[value]]) else NA,
      participant_mean = if (length(people)) mean(people) else NA, low = interval[1], high = interval[2]
    )
  }))
}

# Every test of every two methods, with Holm's correction over the comparisons of one test.
comparisons_of <- function(rows, value, groups, tests, bound = NULL) {
  if (length(groups) < 2 || nrow(rows) == 0) return(NULL)
  people <- sort(unique(rows$participant))
  cells <- sapply(groups, function(group) {
    sapply(people, function(person) rows[[value]][rows$participant == person & rows$group == group], simplify = FALSE)
  }, simplify = FALSE)
  found <- stack_rows(combn(groups, 2, simplify = FALSE, FUN = function(pair) {
    met <- sapply(pair, function(group) lengths(cells[[group]]) > 0)
    met <- matrix(met, ncol = 2)
    both <- people[met[, 1] & met[, 2]]
    mine <- cells[[pair[1]]][both]
    theirs <- cells[[pair[2]]][both]
    differences <- round(as.numeric(mapply(function(a, b) mean(b) - mean(a), mine, theirs)), 12)
    alone <- lapply(1:2, function(i) cells[[pair[i]]][people[met[, i] & !met[, 3 - i]]])
    apart <- lapply(alone, function(group) round(as.numeric(sapply(group, mean)), 12))
    every <- lapply(pair, function(group) rows[[value]][rows$group == group])
    stack_rows(lapply(tests, function(test) {
      result <- switch(test,
        two_sample_t = two_sample_t(every[[1]], every[[2]]), paired_t = paired_t(differences),
        wilcoxon = wilcoxon(differences), mixed_model = mixed_model(mine, theirs),
        cumulative_link = cumulative_link(mine, theirs), equivalence = equivalence(differences, bound),
        welch_t = welch_t(apart[[1]], apart[[2]]), permutation = permutation(apart[[1]], apart[[2]]),
        cumulative_link_between = cumulative_link_between(alone[[1]], alone[[2]]),
        equivalence_between = equivalence_between(apart[[1]], apart[[2]], bound)
      )
      named <- row_of(first = pair[1], second = pair[2], test = test)
      if (is.null(result)) named else cbind(named, result)
    }))
  }))
  if (is.null(found$p)) found$p <- NA_real_
  found$p_holm <- NA_real_
  for (test in setdiff(tests, "two_sample_t")) found$p_holm[found$test == test] <- holm(found$p[found$test == test])
  found
}

of_scales <- function(compute) {
  stack_rows(lapply(SCALES, function(scale) {
    found <- compute(scale)
    if (is.null(found)) NULL else cbind(row_of(scale = scale), found)
  }))
}

means <- function(study) of_scales(function(scale) means_of(study$ratings, scale, study$groups))

people <- function(study) {
  if (nrow(study$ratings) == 0) return(NULL)
  of_scales(function(scale) {
    found <- aggregate(study$ratings[[scale]], study$ratings[c("participant", "group")], mean)
    row_of(participant = found$participant, group = found$group, mean = found$x)
  })
}

comparisons <- function(study) {
  if (study$blinded) return(NULL)
  within <- c("paired_t", "mixed_model", "cumulative_link", "wilcoxon", "equivalence", "two_sample_t")
  tests <- c(within, if (study$between) c("welch_t", "permutation", "cumulative_link_between", "equivalence_between"))
  of_scales(function(scale) comparisons_of(study$ratings, scale, study$groups, tests, study$bound))
}

# Period and carryover (Jones and Kenward 2014): person + method + period, then + the method before.
order_effects <- function(study) {
  if (study$blinded || nrow(study$ratings) == 0) return(NULL)
  of_scales(function(scale) {
    rows <- study$ratings
    blocks <- aggregate(cbind(value = rows[[scale]], place = rows$order), rows[c("participant", "method")], mean)
    blocks <- blocks[order(blocks$participant, blocks$place), ]
    blocks$period <- ave(blocks$place, blocks$participant, FUN = seq_along)
    blocks$before <- c("", head(blocks$method, -1))
    blocks$before[blocks$period == 1] <- ""
    blocks <- blocks[ave(blocks$place, blocks$participant, FUN = length) > 1, ]
    if (length(unique(blocks$participant)) < 4 || max(blocks$period) < 2) return(NULL)
    blocks$period <- factor(blocks$period)
    fits <- list(
      lm(value ~ participant + method, blocks), lm(value ~ participant + method + period, blocks),
      lm(value ~ participant + method + period + before, blocks)
    )
    f_test <- function(name, without, whole) {
      added <- without$df.residual - whole$df.residual
      left <- deviance(whole)
      if (whole$df.residual < 2 || added == 0 || left < 1e-12) return(NULL)
      f <- (deviance(without) - left) / added / (left / whole$df.residual)
      row_of(effect = name, F = f, df = added, df_error = whole$df.residual, p = pf(f, added, whole$df.residual, lower.tail = FALSE))
    }
    later <- NULL
    if (fits[[2]]$df.residual >= 2) {
      names <- paste0("period", levels(blocks$period)[-1])
      ends <- confint(fits[[2]])[names, , drop = FALSE]
      effect <- sub("period", "period_", names)
      later <- row_of(effect = effect, difference = coef(fits[[2]])[names], low = ends[, 1], high = ends[, 2])
    }
    stack_rows(list(f_test("period", fits[[1]], fits[[2]]), f_test("carryover", fits[[2]], fits[[3]]), later))
  })
}

# --- head-to-heads and guesses ---

head_to_heads <- function(study) {
  rows <- study$headtoheads
  rows[yes(rows$counts) & rows$left_method %in% study$groups & rows$right_method %in% study$groups, ]
}

SHARE <- c(left = 1, equal = 0.5, right = 0)

# How often row was preferred to column; equal is half a win for each.
win_table <- function(study) {
  groups <- study$groups
  found <- matrix(0, length(groups), length(groups), dimnames = list(groups, groups))
  rows <- head_to_heads(study)
  for (i in seq_len(nrow(rows))) {
    left <- rows$left_method[i]
    right <- rows$right_method[i]
    found[left, right] <- found[left, right] + SHARE[[rows$response[i]]]
    found[right, left] <- found[right, left] + 1 - SHARE[[rows$response[i]]]
  }
  found
}

wins <- function(study) {
  if (study$blinded || nrow(study$headtoheads) == 0) return(NULL)
  found <- win_table(study)
  row_of(group = rep(study$groups, each = length(study$groups)), against = rep(study$groups, length(study$groups)), wins = c(t(found)))
}

# Whether everybody can be reached from everybody along wins; else no finite strength fits (Ford 1957).
is_connected <- function(won) {
  reached <- (won > 0) | diag(nrow(won)) > 0
  for (i in seq_len(nrow(won))) reached <- (reached %*% reached) > 0
  all(reached)
}

# Bradley and Terry's model as a logistic regression, with a sandwich variance over people. Where no finite strength
# fits or nothing scatters, two groups are compared by the mean over people of how often they prefer the second.
strengths <- function(study) {
  rows <- head_to_heads(study)
  groups <- study$groups
  if (study$blinded || length(unique(rows$participant)) < 4) return(NULL)
  model <- if (is_connected(win_table(study))) strengths_of(rows, groups) else list(shown = NULL, difference_of = function(pair) NULL)
  pairs <- stack_rows(combn(length(groups), 2, simplify = FALSE, FUN = function(pair) {
    result <- row_of(first = groups[pair[1]], second = groups[pair[2]], p = NA)
    told <- model$difference_of(pair)
    if (is.null(told$p)) {
      shares <- shares_of(rows, groups[pair[1]], groups[pair[2]])
      told[names(shares)] <- shares
    }
    result[names(told)] <- told
    result
  }))
  pairs$p_holm <- holm(pairs$p)
  stack_rows(list(model$shown, pairs))
}

# The strength of each group, and a function for the difference of two, by their numbers.
strengths_of <- function(rows, groups) {
  design <- sapply(groups, function(group) (rows$left_method == group) - (rows$right_method == group))[, -1, drop = FALSE]
  won <- unname(SHARE[rows$response])
  fit <- suppressWarnings(glm(won ~ design - 1, family = binomial, control = list(epsilon = 1e-14, maxit = 100)))
  centre <- (diag(length(groups)) - 1 / length(groups))[, -1, drop = FALSE]
  found <- as.numeric(centre %*% coef(fit))
  error_of <- function(contrast) error_of_strengths(design, won, fit$fitted.values, rows$participant, contrast)
  shown <- stack_rows(lapply(seq_along(groups), function(i) {
    error <- error_of(centre[i, ])
    if (is.na(error[1]) || error[1] <= 1e-9) error <- c(NA, NA)
    margin <- if (is.na(error[2])) NA else qt(0.975, error[2]) * error[1]
    row_of(group = groups[i], strength = found[i], low = found[i] - margin, high = found[i] + margin, degrees_of_freedom = error[2])
  }))
  difference_of <- function(pair) {
    difference <- found[pair[2]] - found[pair[1]]
    error <- error_of(centre[pair[2], ] - centre[pair[1], ])
    result <- list(difference = difference, chance = plogis(difference))
    if (is.na(error[1]) || error[1] <= 1e-9) return(result)
    ends <- difference + c(-1, 1) * qt(0.975, error[2]) * error[1]
    c(result, list(
      low = ends[1], high = ends[2], chance_low = plogis(ends[1]), chance_high = plogis(ends[2]),
      p = 2 * pt(-abs(difference / error[1]), error[2]), degrees_of_freedom = error[2], test = "bradley_terry"
    ))
  }
  list(shown = shown, difference_of = difference_of)
}

# How often each person who met both preferred the second: mean, Wilson's interval with people as trials, test.
shares_of <- function(rows, first, second) {
  straight <- rows$left_method == first & rows$right_method == second
  turned <- rows$left_method == second & rows$right_method == first
  won <- unname(SHARE[rows$response])
  met <- straight | turned
  if (length(unique(rows$participant[met])) < 4) return(list())
  shares <- tapply(ifelse(straight, 1 - won, won)[met], as.character(rows$participant[met]), mean)
  ends <- wilson(sum(shares), length(shares))
  found <- list(chance = mean(shares), chance_low = ends[1], chance_high = ends[2])
  beyond <- round(as.numeric(shares) - 0.5, 12)
  if (all(beyond == 0)) found else c(found, list(p = wilcoxon(beyond)$p, test = "wilcoxon"))
}

# Standard error of a difference of strengths and its degrees of freedom; NA where too few people tell.
# A sandwich over people, corrected for the people whom this difference rests on (Bell and McCaffrey 2002).
error_of_strengths <- function(design, won, chances, participant, contrast) {
  weights <- chances * (1 - chances)
  bread <- solve(t(design) %*% (design * weights))
  along <- bread %*% contrast
  parts <- rowsum(design * weights * as.numeric(design %*% along), participant)
  alone <- as.numeric(parts %*% along)
  tells <- alone > 1e-9 * sum(alone)
  seen <- as.numeric(rowsum(design * (won - chances), participant) %*% along)[tells]
  parts <- parts[tells, , drop = FALSE]
  alone <- alone[tells]
  shared <- parts %*% bread %*% t(parts)
  left <- alone - diag(shared)
  if (any(left < 1e-9 * alone)) return(c(NA, NA))
  scale <- sqrt(alone / left)
  model <- outer(scale, scale) * (diag(alone, length(alone)) - shared)
  freedom <- sum(diag(model))^2 / sum(model^2)
  if (freedom < 2) c(NA, NA) else c(sqrt(sum((scale * seen)^2)), freedom)
}

# Whether people knew which robot was made for them, against chance.
guesses <- function(study) {
  rows <- study$forms[study$forms$item %in% "made_for_you" & !yes(study$forms$superseded) & !is.na(study$forms$value), ]
  if (nrow(rows) == 0) return(NULL)
  found <- row_of(people = nrow(rows), robots = length(study$groups), chance = 1 / length(study$groups))
  if (study$blinded) return(found)
  key <- paste(study$all_ratings$participant, study$all_ratings$letter)
  named <- study$all_ratings$method[match(paste(rows$participant, rows$value), key)]
  test <- binom.test(sum(named %in% "pbarl"), nrow(rows), found$chance)
  right <- sum(named %in% "pbarl")
  cbind(found, row_of(right = right, share = right / nrow(rows), low = test$conf.int[1], high = test$conf.int[2], p = test$p.value))
}

# --- questionnaires ---

# Of every part: instrument, score, rows of participant, group and value, groups, items of the same people.
questionnaires <- function(study) {
  parts <- list()
  keys <- unique(study$scoring_key[c("instrument", "score")])
  for (i in seq_len(nrow(keys))) {
    key <- study$scoring_key[study$scoring_key$instrument == keys$instrument[i] & study$scoring_key$score == keys$score[i], ]
    rows <- study$scores[study$scores$instrument == keys$instrument[i] & study$scores$score == keys$score[i], ]
    rows$group <- if (study$blinded) rows$letter else rows$method
    rows$group[is.na(rows$letter)] <- ""
    for (about_robots in c(FALSE, TRUE)) {
      part <- rows[!is.na(rows$letter) == about_robots & !is.na(rows$value), ]
      groups <- if (about_robots) study$groups else ""
      part <- part[part$group %in% groups, ]
      if (nrow(part)) {
        part$participant <- as.character(part$participant)
        items <- items_of(study, part, key)
        parts <- c(parts, list(list(instrument = keys$instrument[i], score = keys$score[i], rows = part, groups = groups, items = items)))
      }
    }
  }
  parts
}

# The items of a score as they enter it: mirrored where they are reversed, the centre where that is the rule.
items_of <- function(study, part, key) {
  given <- study$forms[!yes(study$forms$superseded) & study$forms$form == key$instrument[1], ]
  place <- paste(given$participant, given$letter, given$item)
  low <- key$answer_lowest[1]
  high <- key$answer_highest[1]
  found <- sapply(seq_len(nrow(key)), function(i) {
    values <- suppressWarnings(as.numeric(given$value[match(paste(part$participant, part$letter, key$item[i]), place)]))
    values[is.na(values)] <- (low + high) / 2
    if (yes(key$reversed[i])) low + high - values else values
  })
  matrix(found, nrow = nrow(part))
}

of_questionnaires <- function(study, compute) {
  stack_rows(lapply(questionnaires(study), function(part) {
    found <- compute(part)
    if (is.null(found)) NULL else cbind(row_of(instrument = part$instrument, score = part$score), found)
  }))
}

scale_means <- function(study) {
  of_questionnaires(study, function(part) means_of(part$rows, "value", part$groups, part$rows$lowest[1], part$rows$highest[1]))
}

scale_comparisons <- function(study) {
  if (study$blinded) return(NULL)
  tests <- c("paired_t", "wilcoxon", if (study$between) c("welch_t", "permutation"))
  of_questionnaires(study, function(part) comparisons_of(part$rows, "value", part$groups, tests))
}

scale_reliability <- function(study) {
  of_questionnaires(study, function(part) {
    stack_rows(lapply(part$groups, function(group) {
      cbind(row_of(group = group), reliability(part$items[part$rows$group == group, , drop = FALSE]))
    }))
  })
}

# --- answers to pairs ---

# Answers that count, practice left out.
answered <- function(study) {
  rows <- study$queries
  rows[!is.na(rows$response) & !yes(rows$excluded) & !(rows$purpose %in% "practice"), ]
}

present <- function(study) study$participants$participant[study$participants$status != "withdrawn"]

# 1 foreseen, 0 not, 1/2 without an opinion: of labels that prefer a side, on pairs drawn at random.
hits <- function(rows) {
  rows <- rows[yes(rows$is_label) & rows$strategy %in% "uniform" & !is.na(rows$predicted_right), ]
  rows <- rows[rows$response %in% c("left", "right"), ]
  rows <- rows[order(rows$ordinal), ]
  ifelse(rows$predicted_right == 0.5, 0.5, as.numeric((rows$predicted_right > 0.5) == (rows$response == "right")))
}

# "better": evidence of 20 to 1 against guessing, as often as one looks (Robbins 1970).
foresight <- function(found) {
  correct <- sum(found == 1)
  scored <- sum(found != 0.5)
  tail <- pbeta(0.5, correct + 1, scored - correct + 1, lower.tail = FALSE, log.p = TRUE)
  evidence <- log(2) + tail + lbeta(correct + 1, scored - correct + 1) + scored * log(2)
  if (evidence >= log(20)) return("better")
  if (length(found) < 5 || (length(found) < 20 && correct > scored - correct)) "unknown" else "guessing"
}

# asked, same, share that said equal, of pairs asked twice; can't tell is left out.
same_again <- function(rows) {
  again <- rows[rows$purpose %in% "repeat", ]
  before <- rows$response[match(again$repeats_ordinal, rows$ordinal)]
  swapped <- yes(again$sides_swapped)
  said <- again$response
  said[swapped & again$response == "left"] <- "right"
  said[swapped & again$response == "right"] <- "left"
  told <- !is.na(before) & !(before %in% "skip") & again$response != "skip"
  equal <- sum(before[told] == "equal") + sum(said[told] == "equal")
  c(asked = sum(told), same = sum(said[told] == before[told]), equal = if (any(told)) equal / (2 * sum(told)) else 0)
}

answers <- function(study) {
  everything <- answered(study)
  stack_rows(lapply(present(study), function(person) {
    rows <- everything[everything$participant == person, ]
    labels <- rows[yes(rows$is_label), ]
    times <- rows$response_time_ms[!is.na(rows$response_time_ms)]
    foreseen <- hits(rows)
    again <- same_again(rows)
    row <- row_of(participant = person, labels = nrow(labels))
    for (said in c("left", "right", "equal", "skip")) row[[said]] <- sum(labels$response == said)
    row$median_response_ms <- if (length(times)) median(times) else NA
    row$working_minutes <- if (length(times)) sum(times) / 60000 else NA
    row$foresight <- foresight(foreseen)
    row$correct <- sum(foreseen)
    row$scored <- length(foreseen)
    if (length(foreseen)) {
      row$accuracy <- mean(foreseen)
      row[c("accuracy_low", "accuracy_high")] <- wilson(sum(foreseen), length(foreseen))
    }
    row$asked <- again[["asked"]]
    row$same <- again[["same"]]
    by_chance <- again[["equal"]]^2 + (1 - again[["equal"]])^2 / 2
    if (row$asked > 0) {
      row$share <- row$same / row$asked
      row[c("share_low", "share_high")] <- wilson(row$same, row$asked)
    }
    if (row$asked >= 5 && by_chance < 1) { # Cohen's kappa of the symmetric table
      row[c("kappa", "kappa_low", "kappa_high")] <- (row[c("share", "share_low", "share_high")] - by_chance) / (1 - by_chance)
    }
    row
  }))
}

answers_pooled <- function(study) {
  rows <- answers(study)
  if (is.null(rows)) return(NULL)
  shares <- rows$accuracy[!is.na(rows$accuracy)]
  interval <- mean_interval(shares, 0, 1)
  row_of(
    people = length(shares), mean_accuracy = if (length(shares)) mean(shares) else NA, mean_low = interval[1],
    mean_high = interval[2], labels = sum(rows$labels), asked = sum(rows$asked), same = sum(rows$same)
  )
}

# Attention: obvious pairs that were answered, and those answered the wrong way; can't tell is no answer.
catch_pairs <- function(study) {
  rows <- answered(study)
  rows <- rows[rows$purpose %in% "catch" & !is.na(rows$expected) & rows$response != "skip", ]
  row_of(answered = nrow(rows), wrong = sum(rows$response %in% c("left", "right") & rows$response != rows$expected))
}

curves <- function(study) {
  everything <- answered(study)
  stack_rows(lapply(present(study), function(person) {
    foreseen <- hits(everything[everything$participant == person, ])
    if (length(foreseen) < FIRST_POINT) return(NULL)
    scored <- FIRST_POINT:length(foreseen)
    row_of(participant = person, scored = scored, accuracy = sapply(scored, function(n) mean(foreseen[max(1, n - WINDOW + 1):n])))
  }))
}

# Who came how far; sent back: screened out, no arm open, missed catch pairs.
recruitment <- function(study) {
  rows <- study$participants
  there <- rows[rows$status != "withdrawn", ]
  consented <- !is.na(there$consented_at)
  finished <- there$status == "completed"
  ended <- function(reason) sum(consented & !finished & there$ended_as %in% reason)
  row_of(
    invited = nrow(rows), withdrawn = nrow(rows) - nrow(there), consented = sum(consented),
    screened_out = ended("screened_out"), full = ended("full"), inattentive = ended("inattentive"),
    completed = sum(consented & finished), unfinished = sum(consented & !finished & is.na(there$ended_as))
  )
}

# --- what the filters change ---

change <- function(study) {
  rows <- study$evaluations[yes(study$evaluations$newest) & study$evaluations$participant %in% present(study), ]
  rows[c("participant", "measure", "reference", "filtered", "delta", "low", "high")]
}

change_pooled <- function(study) {
  rows <- change(study)
  stack_rows(lapply(unique(rows$measure), function(measure) {
    mine <- rows[rows$measure == measure, ]
    deltas <- mine$delta[!is.na(mine$delta)]
    interval <- mean_interval(deltas)
    references <- mine$reference[!is.na(mine$reference)]
    row_of(
      measure = measure, people = length(deltas), mean = if (length(deltas)) mean(deltas) else NA, low = interval[1],
      high = interval[2], reference = if (length(references)) mean(references) else NA
    )
  }))
}

# --- figures ---

COLOURS <- c("#d9d9d9", "#e69f00", "#0072b2", "#56b4e9", "#762a83")
INK <- "#262626"
GREY <- "#8a8a8a"
BLUE <- "#0072b2"

name_of <- function(group) ifelse(group %in% names(NAMES), NAMES[group], paste("Robot", group))

# Where it has to be drawn: a function for each figure, which draws nothing and says FALSE where there is nothing.
ratings_figure <- function(study) {
  if (nrow(study$ratings) == 0) return(FALSE)
  par(mfrow = c(1, 2))
  tests <- comparisons(study)
  for (scale in SCALES) {
    found <- means_of(study$ratings, scale, study$groups)
    mine <- tests[tests$scale %in% scale & tests$test %in% "two_sample_t" & !is.na(tests$p), ]
    top <- 5.7 + 0.5 * max(0, nrow(mine))
    at <- barplot(
      found$mean - 1, offset = 1, ylim = c(1, top), xpd = FALSE, col = COLOURS, names.arg = name_of(study$groups),
      cex.names = 0.6, main = scale, ylab = "Mean rating (1 to 5)"
    )
    spread <- !is.na(found$sd)
    arrows(
      at[spread], (found$mean - found$sd)[spread], at[spread], (found$mean + found$sd)[spread], angle = 90, code = 3,
      length = 0.04
    )
    for (i in seq_len(max(0, nrow(mine)))) {
      ends <- at[match(c(mine$first[i], mine$second[i]), study$groups)]
      lines(ends, rep(4.7 + 0.5 * i, 2))
      text(mean(ends), 4.85 + 0.5 * i, if (mine$p[i] < 0.01) "*" else "n.s.", cex = 0.8)
    }
  }
  TRUE
}

ratings_of_each_person <- function(study) {
  if (nrow(study$ratings) == 0) return(FALSE)
  par(mfrow = c(1, 2))
  for (scale in SCALES) {
    person <- tapply(study$ratings[[scale]], study$ratings[c("group", "participant")], mean)
    person <- person[match(study$groups, rownames(person)), , drop = FALSE]
    matplot(
      person, type = "o", pch = 1, lty = 1, col = GREY, ylim = c(0.8, 5.2), xlim = c(0.7, length(study$groups) + 0.4),
      xaxt = "n", main = scale, xlab = "", ylab = "Mean rating of each person"
    )
    axis(1, seq_along(study$groups), name_of(study$groups), cex.axis = 0.6)
    found <- means_of(study$ratings, scale, study$groups)
    at <- seq_along(study$groups) + 0.22
    points(at, found$participant_mean, pch = 18, col = BLUE)
    segments(at, found$low, at, found$high, col = BLUE, lwd = 2)
  }
  TRUE
}

head_to_heads_figure <- function(study) {
  found <- strengths(study)
  if (is.null(found$strength)) return(FALSE)
  found <- found[!is.na(found$strength), ]
  found <- found[order(found$strength), ]
  par(mar = c(5, 10, 2, 1))
  ends <- range(0, found$strength, found$low, found$high, na.rm = TRUE)
  plot(
    found$strength, seq_len(nrow(found)), pch = 18, col = BLUE, xlim = ends, yaxt = "n", ylab = "",
    xlab = "Strength (log odds against the average robot; right: preferred)"
  )
  segments(found$low, seq_len(nrow(found)), found$high, seq_len(nrow(found)), col = GREY)
  abline(v = 0)
  axis(2, seq_len(nrow(found)), name_of(found$group), las = 1)
  TRUE
}

learning_curves <- function(study) {
  found <- curves(study)
  if (is.null(found) || all(table(found$participant) < 2)) return(FALSE)
  table <- tapply(100 * found$accuracy, found[c("scored", "participant")], mean)
  table <- table[, colSums(!is.na(table)) > 1, drop = FALSE]
  scored <- as.numeric(rownames(table))
  matplot(
    scored, table, type = "l", lty = 1, col = GREY, ylim = c(0, 101),
    xlab = "Answers that preferred a side, on pairs drawn at random",
    ylab = paste("Predicted correctly of the last", WINDOW, "(%)")
  )
  whole <- rowSums(is.na(table)) == 0
  if (ncol(table) > 1) lines(scored[whole], rowMeans(table)[whole], col = BLUE, lwd = 2)
  abline(h = 50, lty = 2)
  TRUE
}

success_against_preference <- function(study) {
  found <- change(study)
  x <- found[found$measure == "preference", ]
  y <- found[found$measure == "success", ]
  both <- intersect(x$participant, y$participant)
  if (length(both) == 0) return(FALSE)
  x <- x[match(both, x$participant), ]
  y <- y[match(both, y$participant), ]
  proven <- answers(study)
  proven <- proven$participant[proven$foresight == "better"]
  plot(
    x$delta, 100 * y$delta, pch = ifelse(both %in% proven, 16, 1), col = BLUE, xlim = range(0, x$low, x$high),
    ylim = range(0, 100 * y$low, 100 * y$high), ylab = "Change of success (percentage points)",
    xlab = "Change of preference (SD of the reference's return, as the person's own model sees it)"
  )
  segments(x$low, 100 * y$delta, x$high, 100 * y$delta, col = GREY)
  segments(x$delta, 100 * y$low, x$delta, 100 * y$high, col = GREY)
  abline(h = 0, v = 0)
  text(x$delta, 100 * y$delta, both, pos = 4, cex = 0.7)
  TRUE
}

cost_changes <- function(study) {
  found <- change(study)
  names <- COSTS[COSTS %in% found$measure]
  if (length(names) == 0) return(FALSE)
  found <- found[found$measure %in% names & !is.na(found$delta) & !(found$reference %in% c(0, NA)), ]
  relative <- 100 * found$delta / found$reference
  row <- match(found$measure, names)
  plot(
    relative, row, col = GREY, xlim = range(0, relative), ylim = c(length(names) + 0.5, 0.5), yaxt = "n", ylab = "",
    xlab = "Change in % of the reference (left: less of the cost)"
  )
  points(tapply(relative, row, mean), as.numeric(names(tapply(relative, row, mean))), pch = 18, col = BLUE)
  axis(2, seq_along(names), names, las = 1)
  abline(v = 0)
  TRUE
}

TABLES <- c(
  "recruitment", "catch_pairs", "answers", "answers_pooled", "curves", "change", "change_pooled", "means", "people",
  "comparisons", "order_effects", "wins", "strengths", "guesses", "scale_means", "scale_comparisons", "scale_reliability"
)
FIGURES <- list(
  ratings = ratings_figure, ratings_of_each_person = ratings_of_each_person, head_to_heads = head_to_heads_figure,
  learning_curves = learning_curves, success_against_preference = success_against_preference, cost_changes = cost_changes
)

main <- function(source, target) {
  study <- read_study(source)
  dir.create(target, showWarnings = FALSE, recursive = TRUE)
  for (table in TABLES) {
    found <- get(table)(study)
    path <- file.path(target, paste0(table, ".csv"))
    if (is.null(found)) {
      file.create(path)
    } else {
      write.csv(found, path, row.names = FALSE, na = "", fileEncoding = "UTF-8")
    }
  }
  for (figure in names(FIGURES)) {
    path <- file.path(target, paste0(figure, ".pdf"))
    pdf(path, width = 6.4, height = 4)
    drawn <- FIGURES[[figure]](study)
    dev.off()
    if (!drawn) unlink(path)
  }
  cat("Tables and figures of", length(present(study)), "participants are in", target, "\n")
  if (study$blinded) cat("The study is blinded: letters stand for methods, and nothing is compared.\n")
}

if (sys.nframe() == 0) {
  script <- sub("^--file=", "", grep("^--file=", commandArgs(FALSE), value = TRUE))
  here <- if (length(script)) dirname(script) else "."
  given <- commandArgs(TRUE)
  main(
    if (length(given) > 0) given[1] else file.path(here, "csv"),
    if (length(given) > 1) given[2] else file.path(here, "analysis")
  )
}
