# Analyses of an exported study by R's packages, without our script: Rscript by_hand.R csv result.csv
# One number a row: which analysis, of what, and its value.
suppressMessages({
  library(ordinal)
  library(lmerTest)
})
folder <- commandArgs(TRUE)[1]
read <- function(name) read.csv(file.path(folder, paste0(name, ".csv")), na.strings = "", stringsAsFactors = FALSE)
yes <- function(column) tolower(as.character(column)) == "true"
methods <- read("methods")$method
bound <- read("methods")$equivalence_bound[1]
ratings <- read("ratings")
ratings <- ratings[yes(ratings$counts), ]
rows <- list()
add <- function(scale, first, second, analysis, ...) {
  values <- c(...)
  rows[[length(rows) + 1]] <<- data.frame(scale, first, second, analysis, quantity = names(values), value = unname(values))
}
of_test <- function(found) c(statistic = unname(found$statistic), p = found$p.value)
one_sided <- function(...) {
  max(t.test(..., mu = -bound, alternative = "greater")$p.value, t.test(..., mu = bound, alternative = "less")$p.value)
}
odds <- function(data) {
  data$level <- factor(data$y, ordered = TRUE)
  data$participant <- factor(data$participant)
  clmm(level ~ group + (1 | participant), data, nAGQ = 10)
}
of_odds <- function(fit) {
  found <- summary(fit)$coefficients
  effect <- found[grep("^group", rownames(found)), ]
  c(difference = effect[[1]], standard_error = effect[[2]], p = effect[[4]])
}
sd_of <- function(fit) unname(attr(VarCorr(fit)$participant, "stddev")[1])

for (scale in c("satisfaction", "personalisation")) {
  for (pair in combn(methods, 2, simplify = FALSE)) {
    mine <- ratings[ratings$method %in% pair, ]
    mine$y <- mine[[scale]]
    mine$group <- factor(mine$method, pair)
    met <- tapply(mine$group, mine$participant, function(each) length(unique(each)))
    both <- mine[mine$participant %in% names(which(met == 2)), ]
    alone <- mine[mine$participant %in% names(which(met == 1)), ]
    say <- function(analysis, ...) add(scale, pair[1], pair[2], analysis, ...)
    if (length(unique(both$participant)) > 3) {
      means <- tapply(both$y, both[c("participant", "group")], mean)
      say("paired_t", of_test(t.test(means[, 2], means[, 1], paired = TRUE)))
      say("equivalence", p = one_sided(means[, 2], means[, 1], paired = TRUE))
      linear <- suppressMessages(lmer(y ~ group + (group | participant), both))
      found <- summary(linear)$coefficients[2, ]
      say("lmer", difference = found[[1]], standard_error = found[[2]], p = found[[5]])
      fit <- odds(both)
      say("clmm", of_odds(fit), sd_between_people = sd_of(fit))
    }
    if (length(unique(alone$group)) == 2) {
      means <- aggregate(y ~ participant + group, alone, mean)
      groups <- split(means$y, means$group)
      if (min(lengths(groups)) >= 3) {
        say("welch_t", of_test(t.test(groups[[2]], groups[[1]])))
        say("equivalence_between", p = one_sided(groups[[2]], groups[[1]]))
        say("oneway.test", p = oneway.test(y ~ group, means)$p.value)
        fit <- odds(alone)
        say("clmm between", of_odds(fit), sd_between_people = sd_of(fit))
      }
    }
  }
  blocks <- aggregate(cbind(y = ratings[[scale]], place = ratings$order), ratings[c("participant", "method")], mean)
  blocks <- blocks[order(blocks$participant, blocks$place), ]
  blocks$before <- ave(blocks$method, blocks$participant, FUN = function(each) c("none", head(each, -1)))
  blocks$period <- factor(ave(blocks$place, blocks$participant, FUN = seq_along))
  blocks <- blocks[ave(blocks$place, blocks$participant, FUN = length) > 1, ]
  fits <- list(
    lm(y ~ participant + method, blocks), lm(y ~ participant + method + period, blocks),
    lm(y ~ participant + method + period + before, blocks)
  )
  for (i in 1:2) {
    compared <- anova(fits[[i]], fits[[i + 1]])
    add(scale, "", "", c("period", "carryover")[i], F = compared$F[2], p = compared[["Pr(>F)"]][2])
  }
}

answers <- read("headtoheads")
answers <- answers[yes(answers$counts), ]
design <- sapply(methods, function(each) (answers$left_method == each) - (answers$right_method == each))[, -1]
won <- c(left = 1, equal = 0.5, right = 0)[answers$response]
bradley_terry <- function(kept) {
  found <- c(0, coef(suppressWarnings(glm(won[kept] ~ design[kept, ] - 1, family = quasibinomial))))
  found - mean(found)
}
strengths <- bradley_terry(TRUE)
people <- unique(answers$participant)
without <- sapply(people, function(each) bradley_terry(answers$participant != each))
jackknife <- sqrt((length(people) - 1) / length(people) * rowSums((without - rowMeans(without))^2))
for (i in seq_along(methods)) {
  add("", methods[i], "", "Bradley-Terry", strength = strengths[[i]])
  add("", methods[i], "", "jackknife", standard_error = jackknife[[i]])
}
write.csv(do.call(rbind, rows), commandArgs(TRUE)[2], row.names = FALSE)
